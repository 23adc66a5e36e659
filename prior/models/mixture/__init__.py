"""A mixture of experts that smooths observed joints: linear filters, weighted by a network of the whole body."""
