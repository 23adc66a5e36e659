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
    **{f"002_{trial:02d}": f"02_{trial:02d}" for trial in range(1, 11)},
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
    "08_02": "train_walking_13",
    "08_03": "train_walking_14",
    "08_08": "train_walking_15",
    "08_09": "train_walking_16",
    "08_10": "train_walking_17",
    "10_01": "train_soccer_1",
    "10_02": "train_soccer_2",
    "10_03": "train_soccer_3",
    "10_04": "train_walking_18",
    "10_05": "train_soccer_4",
    "10_06": "train_soccer_5",
    "11_01": "test_soccer_1",
    "12_01": "train_walking_19",
    "12_02": "train_walking_20",
    "12_03": "train_walking_21",
    "13_11": "train_jumping_1",
    "13_19": "train_jumping_3",
    "13_26": "train_directing_traffic_1",
    "13_32": "train_jumping_4",
    "13_39": "train_jumping_5",
    "14_12": "test_washwindow_1",
    "14_36": "14_31",
}
"""Recordings that two CMU archives hold: the one left out, and the one kept (nearer to the source, or validating).

Found by the bends of elbows and knees, frame by frame: 0.1 degrees apart for AMC and exponential maps, below 1.7 for
the hobbyist's BVH, against more than 5 between any two other recordings at the same lag. Those of `cmu_more` stand on
another body, whose elbows and knees are bent by 11 to 16 degrees more all the time: that taken off, 0.4 to 2.5 degrees
for two of one length, and 2.7 or more for the next.
"""

NORMALISED = "first2s"
"""The folder of `cmu_more` whose takes somebody has stretched to 240 frames, whatever they lasted: walks and runs all
take one step a second there, and those that are also in `cmu_more` itself match it at 0.5 to 0.6 of their speed, jumps
at 1.3 to 2. No file says by how much, and motion at a wrong speed teaches wrong speeds."""
