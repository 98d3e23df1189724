"""The paper's own figures, in one place: its protocol, its Table 1 and its Table 2.

*ST-MNIST - The Spiking Tactile-MNIST Neuromorphic Dataset* (See et al., 2020).
"""

# Rows and columns of taxels (Section 2.1).
ROWS = COLUMNS = 10

# Number of classes, the ten digits.
CLASSES = 10

# People who wrote the digits (Section 2.2).
WRITERS = 23

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
