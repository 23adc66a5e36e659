"""The wire: messages, codec, transport and recordings. Importing it needs no torch."""
