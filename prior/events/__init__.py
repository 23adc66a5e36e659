"""Detects events in ``pose/world``: entered, came near, sits, fell, raised a hand, waves, points, and so on.

`features` computes the quantities that events depend on from one body's joints, with their standard deviations.
`trigger` turns a quantity into a condition that begins and ends. `detector` detects the events of all bodies of a
stream.
"""
