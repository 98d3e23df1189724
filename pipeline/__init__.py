"""From recordings to a bundle: read or simulate, make images, train, convert, measure, report."""
