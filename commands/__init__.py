"""The command line, a file a subject. Nothing heavy is imported before a command runs."""
