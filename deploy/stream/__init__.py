"""A running sensor: its events as they come, the network in real time, and its decisions.

``clock`` puts the events in order and counts faults, ``presentation`` runs the network step by
step, and ``stream`` has the class :class:`~deploy.stream.stream.Stream`.
"""
