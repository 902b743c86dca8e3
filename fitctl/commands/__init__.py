"""What each command of fitctl does.

The command lines themselves are in `running`, `attending`, `describing`, `computing`, `reporting`, `faulting`,
`keys`, `log` and `sequence`. All of these are imported for any command and for ``--help``, so what is slow to
import, they import inside the command that needs it.
"""
