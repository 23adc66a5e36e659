"""The processes: each takes topics and gives topics; and the command line."""
