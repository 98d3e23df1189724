"""The skin in the browser: write or draw on it, watch the spikes, save the recording.

``writing`` (in :mod:`pipeline.skin`) makes events from a pen's points, ``examples`` has recordings
to play in its place, ``deciding`` runs the network on them, ``keeping`` writes recordings to a
folder, ``learning`` fits the network to a writer, ``session`` joins them behind messages,
``server`` carries the messages to the page in ``page/``.  ``network`` tells the sensor and the
classes of a network, ``connections`` limits who may connect, ``qr`` draws the address, and
``serving`` puts all of it together.
"""
