"""A running sensor: its events as they come, the network in real time, and its decisions.

``events`` reads the columns of events, ``clock`` puts them in order, and ``faults`` counts those
that cannot be used.  ``touch`` has the steps of a touch and its decision, ``presentation`` runs the
network step by step, and ``stream`` has the class :class:`~deploy.stream.stream.Stream`.
"""
