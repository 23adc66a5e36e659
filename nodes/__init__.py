"""The nodes, which are processes that subscribe to topics and publish topics; and the command line."""
