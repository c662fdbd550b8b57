"""The command line: table of commands, options, progress, output and exit codes."""
