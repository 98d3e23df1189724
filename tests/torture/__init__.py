"""Campaigns of damaged and hostile input, kills and interruptions: ``make torture``.

Each case is drawn from a seed and a number alone, so that whatever is found can be replayed.
"""
