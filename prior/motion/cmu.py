"""What the recordings of the CMU Graphics Lab Motion Capture Database show, and which of them come twice."""

CMU_ACTIONS = {
    "01": "playground",
    "02_01": "walk",
    "02_02": "walk",
    "02_03": "run",
    "02_04": "jump, balance",
    "02_05": "punch",
    "02_06": "bend, lift",
    "02_07": "swordplay",
    "02_08": "swordplay",
    "02_09": "swordplay",
    "02_10": "wash",
    "06": "basketball",
    "07": "walk",
}
"""By subject, or by subject and trial."""


REPEATS = {
    "002_01": "02_01",
    "002_02": "02_02",
    "002_03": "02_03",
    "002_04": "02_04",
    "002_05": "02_05",
    "002_06": "02_06",
    "002_07": "02_07",
    "002_08": "02_08",
    "002_09": "02_09",
    "002_10": "02_10",
    "006_01": "train_walking_3",
    "006_02": "train_basketball_1",
    "006_03": "train_basketball_2",
    "006_04": "train_basketball_3",
    "006_05": "train_basketball_4",
    "006_06": "train_basketball_5",
    "006_07": "test_basketball_1",
    "007_01": "train_walking_4",
    "007_02": "train_walking_5",
    "train_walking_1": "02_01",
}
"""Recordings that two CMU archives hold: the one left out, and the one kept (nearer to the source, or validating).

Found by the bends of elbows and knees, frame by frame: 0.1 degrees apart for AMC and exponential maps, below 1.7 for
the hobbyist's BVH, against more than 5 between any two other recordings at the same lag.
"""
