"""The skin in the browser: writing or drawing on it, spikes, saved recordings.

``writing`` (in :mod:`pipeline.skin`) makes events from a pen's points, ``examples`` has recordings
to play instead, ``deciding`` runs the network on them, ``keeping`` writes recordings to a folder,
``learning`` fits the network to a writer, ``session`` handles the messages of a page, and
``server`` exchanges them with the page in ``page/``.  ``network`` determines the sensor and the
classes of a network, ``connections`` limits connections, ``qr`` draws the address, and ``serving``
connects all of these.
"""
