"""Recordings: events, MAT files, archives of them, the cache, and the counts of Table 1."""
