"""The kinds of networks, a folder each; :mod:`.kind` says what depends on the kind."""
