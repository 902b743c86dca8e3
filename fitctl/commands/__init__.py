"""The commands of ``fitctl``, one module each; ``fitctl/cli.py`` lists them and imports what is needed.

A module holds a command's options and what it does. It has a function of the command's name, or where the
command has commands of its own, a typer app `app`.
"""
