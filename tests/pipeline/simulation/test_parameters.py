"""The parameters of the simulation."""

import pytest

from pipeline.simulation.parameters import Population, read_parameters

OTHERS = Population(
    people=10, chunked_share=0.2, tablet_share=0.5, reversed_share=0.3, mixed_form_share=0.25
)


@pytest.mark.parametrize(
    ("population", "hash_begins"),
    [
        (Population(), "d9891c224e2ae05b"),
        (Population(people=10), "6bb0a02d1752e7f1"),
        (OTHERS, "ad7a0d9934c52008"),
    ],
)
def test_recordings_that_were_simulated_before_keep_their_hash(population, hash_begins):
    """The hashes change with ``parameters.toml`` and the fitted files only."""
    assert read_parameters(population).compute_hash().startswith(hash_begins)
