"""A user's own data set: four gestures on 9 rows of 12 taxels, as an event camera writes them."""

import numpy as np

from tests.pipeline.handmade import npz

ROWS, COLUMNS = 9, 12
# Of 29 to 37 characters, with blanks and umlauts, in alphabetical order.
CLASSES = (
    "diagonal über die ganze Fläche",
    "quer von links nach rechts gestrichen",
    "runder Kreis, einmal ganz herum",
    "senkrecht von oben nach unten",
)


def gesture(label, rng, n=80):
    """The events of one recording.

    Returns
    -------
    x, y, t, p : ndarray, shape (n,)
        Column from the left, row from the top, seconds, and 1 or -1.
    """
    along, lasts = np.sort(rng.uniform(0, 1, n)), rng.uniform(0.3, 1.9)
    x0, y0 = rng.normal(5.5, 0.8), rng.normal(4, 0.6)
    x, y = (
        (11 * along, 8 * along),
        (11 * along, y0 + 0 * along),
        (x0 + 4 * np.cos(2 * np.pi * along), y0 + 3 * np.sin(2 * np.pi * along)),
        (x0 + 0 * along, 8 * along),
    )[label]
    x, y = (
        np.clip(np.rint(a + rng.normal(0, 0.4, n)), 0, side - 1).astype(int)
        for a, side in ((x, COLUMNS), (y, ROWS))
    )
    return x, y, 0.05 + along * lasts, rng.choice([-1, 1], n)


def gestures(per_class, seed=0):
    """``(events, label)`` of each recording, class by class; events as of :func:`gesture`."""
    rng = np.random.default_rng(seed)
    return [(gesture(label, rng), label) for label in range(len(CLASSES)) for _ in range(per_class)]


def owners_image(events):
    """Counts of events, divided by the largest: [row, column], as every camera's owner draws it."""
    x, y, _, _ = events
    image = np.zeros((ROWS, COLUMNS))
    np.add.at(image, (y, x), 1)
    return image / image.max()


def npz_bytes(events) -> bytes:
    """A recording as a ``.npz`` of x, y, t, p."""
    return npz(**dict(zip("xytp", events, strict=True)))


def write_folder(folder, per_class, seed=0):
    """A folder of ``.npz`` files in a folder for each class; returns it."""
    numbers = dict.fromkeys(range(len(CLASSES)), 0)
    for events, label in gestures(per_class, seed):
        place = folder / CLASSES[label]
        place.mkdir(parents=True, exist_ok=True)
        (place / f"{numbers[label]:03d}.npz").write_bytes(npz_bytes(events))
        numbers[label] += 1
    return folder
