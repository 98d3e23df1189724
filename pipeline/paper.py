"""The paper's own figures, in one place: its protocol, its Table 1 and its Table 2.

*ST-MNIST - The Spiking Tactile-MNIST Neuromorphic Dataset* (See et al., 2020).
"""

from __future__ import annotations

# Rows and columns of taxels (Section 2.1).
ROWS = COLUMNS = 10

# Number of classes, the ten digits.
CLASSES = 10

# Length of a recording in seconds (Section 2.2).
DURATION_S = 2.0

# Share of test samples in its random 80-20 splits (Section 3.2).
TEST_FRACTION = 0.2

# Multiply-accumulates of an inference of its CNN, 10x10-6c4-24c3-10o (Fig. 4).
CNN_MACS = 43104

# Test samples drawn at random for Loihi (Section 3.2.2).
CHECK_SAMPLES = 200

# Recordings of each digit, 6,953 in all (Table 1).
SAMPLES_PER_DIGIT = (697, 690, 699, 690, 690, 693, 698, 704, 697, 695)

# Accuracy of each model over the splits, mean and SD (Table 2).
TABLE2 = {
    "cnn": (0.89, 0.01),
    "ann-snn": (0.87, 0.01),
    "loihi": (0.86, 0.02),
    "slayer": (0.81, 0.01),
}


def points_lost(model: str) -> float:
    """Points of accuracy from the paper's CNN to another model of its Table 2."""
    return 100 * (TABLE2["cnn"][0] - TABLE2[model][0])


_TABLE1 = {
    "on": [
        (1738.13, 1365.54), (362.95, 204.57), (878.78, 405.13), (1053.44, 673.43),
        (823.63, 458.51), (1113.90, 701.60), (739.37, 521.99), (809.30, 631.05),
        (1399.14, 898.56), (773.13, 483.25),
    ],
    "off": [
        (1139.66, 803.17), (245.77, 124.34), (623.88, 294.57), (810.22, 1403.10),
        (597.57, 355.25), (819.76, 677.03), (548.48, 410.00), (538.98, 361.39),
        (1000.42, 755.04), (546.29, 295.75),
    ],
    "x_mean": [
        (5.57, 0.51), (6.17, 0.70), (6.57, 0.70), (5.88, 0.59), (6.05, 0.57),
        (5.41, 0.53), (6.04, 0.45), (5.32, 0.57), (5.78, 0.57), (5.24, 0.54),
    ],
    "y_mean": [
        (6.84, 0.75), (6.21, 1.16), (7.02, 0.82), (7.12, 0.88), (6.93, 0.93),
        (6.57, 0.79), (6.68, 0.76), (6.92, 0.89), (6.76, 0.90), (6.58, 0.91),
    ],
    "x_range": [
        (8.92, 0.53), (8.72, 0.70), (8.80, 0.64), (8.94, 0.53), (8.95, 0.52),
        (8.91, 0.58), (8.94, 0.52), (8.96, 0.49), (8.94, 0.52), (8.91, 0.53),
    ],
    "y_range": [
        (8.48, 1.04), (7.04, 1.36), (8.21, 1.04), (8.20, 1.08), (8.44, 0.87),
        (8.38, 1.00), (8.33, 1.02), (7.97, 1.18), (8.19, 1.17), (8.17, 1.13),
    ],
    "samples": SAMPLES_PER_DIGIT,
}  # fmt: skip

# Table 1: for each digit a pair (mean, SD) for each measure of the measures of
# :func:`pipeline.data.statistics.per_sample`, and ``samples``.
TABLE1 = {digit: {name: row[digit] for name, row in _TABLE1.items()} for digit in range(10)}
