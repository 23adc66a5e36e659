"""What is wrong with a stream, in words: causes that a user can act on, while the stream runs."""
