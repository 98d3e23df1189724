"""Limits of everything that is read from outside: files and settings.

They are far above useful values and far below values that cause problems for a machine.  A value
beyond them is reported as a mistake of the user.
"""

# Steps of a sample, and of the gap before it.
STEPS = 10_000

# Samples of a check, and recordings of a digit.
SAMPLES = 1_000_000

EPOCHS = 10_000_000
BATCH = 1_000_000

# Neurons of a layer and values of an input: a whole chip, 128 cores of 1,024.
NEURONS = 131_072

# Weights of a network.
WEIGHTS = 20_000_000

# Largest time constant in seconds.
SECONDS = 1_000.0

REFRACTORY_S = 1.0

# Largest voltage or amplitude in units of the threshold, weight and pixel value.
MAGNITUDE = 1e9

LAYERS = 100

SYNAPSES_PER_WEIGHT = 8

# Largest number of bytes of all arrays in a file.
ARRAY_BYTES = 1 << 30

# Largest number of bytes of a JSON file.
TEXT_BYTES = 1 << 28

# Largest number of bytes of a file of settings.
SETTINGS_BYTES = 1 << 20
