"""How each kind of step works: what it checks, commands, watches and ends."""
