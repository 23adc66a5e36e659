"""A mixture of linear filters, weighed by a network that sees the whole body: what smooths joints that are seen."""
