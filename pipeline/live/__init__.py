"""The skin in the browser: write a digit, watch the spikes, save the recording.

``writing`` (in :mod:`pipeline.skin`) makes events from a pen's points, ``deciding`` runs the
network on them, ``keeping`` writes recordings to a folder, ``session`` joins the three behind
messages, ``server`` carries the messages to the page in ``page/``.  ``robot`` writes on the page in
the place of a hand, and ``latency`` measures how soon it answers.
"""
