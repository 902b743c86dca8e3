"""Hidden commands: the processes that a supervisor starts beside itself."""
