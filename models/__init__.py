"""Networks as values: notation, operations, chains, integers; import from Keras and NIR."""
