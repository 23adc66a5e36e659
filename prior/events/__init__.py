"""What people do, from ``pose/world``: entered, came near, sits, fell, raised a hand, waves, points, and so on.

`features` computes from one body's joints the quantities that events depend on, with their standard deviations;
`trigger` turns a quantity into something that begins and ends; `detector` holds what every body of a stream does.
"""
