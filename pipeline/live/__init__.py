"""The skin in the browser: writing or drawing on it, spikes, saved recordings.

``writing`` (in :mod:`pipeline.simulation`) makes events from a pen's points, ``examples`` has
recordings to play instead, ``deciding`` runs the network on them, and ``keeping`` writes
recordings to a folder.  ``recording`` is what is on the skin of a page, ``messages`` reads and
makes the messages of a page, ``session`` handles them, and ``server`` exchanges them with the page
in ``page/``.  ``network`` determines the sensor and the classes of a network, and ``serving``
connects all of these.
"""

PORT = 8765

# Folder for recordings of digits; of other data the start of its name.
RECORD = "written"
