"""The skin in the browser: write a digit, watch the spikes, keep the recording.

``writing`` (in :mod:`pipeline.skin`) makes events of a pen's points, ``deciding`` lets the network
answer to them, ``keeping`` writes recordings to a folder, ``session`` joins the three behind
messages, ``server`` carries the messages to the page in ``page/``.  ``robot`` writes on the page in
the place of a hand, and ``latency`` measures how soon it answers.
"""
