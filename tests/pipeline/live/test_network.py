"""The sensor, the classes and the folder that the page has for a network."""

from dataclasses import replace

import pytest

from deploy.check.bundle import Bundle, read_bundle
from deploy.errors import UserError
from pipeline.live.network import SHIPPED, describe_for_page, find_record_folder, find_sensor
from pipeline.recordings.sensor import Sensor
from tests.own_sensor import CLASSES

BUNDLE = read_bundle(SHIPPED)


def changed(shape=(9, 12, 2), inputs=None, **provenance) -> Bundle:
    """The package's bundle with another description; its layers are not looked at here."""
    spec = replace(BUNDLE.spec, provenance=BUNDLE.spec.provenance.with_entries(**provenance))
    object.__setattr__(spec, "input_shape", shape)
    checks = BUNDLE.checks if inputs is None else replace(BUNDLE.checks, inputs=inputs)
    return replace(BUNDLE, spec=spec, checks=checks)


def test_the_network_of_the_package_is_for_digits():
    sensor = find_sensor(BUNDLE)
    assert sensor == Sensor()
    assert find_record_folder(BUNDLE, sensor) == "written"
    assert describe_for_page(BUNDLE, sensor, "written")["digits"] is True


def test_a_data_set_of_ones_own_has_its_words_and_a_folder_of_its_own():
    names = [*CLASSES, *(f"Klasse {n}" for n in range(6))]
    bundle = changed(classes=names, source="Über/own data (2).zip", polarities=1)
    sensor = find_sensor(bundle)
    assert sensor == Sensor(9, 12, 1, classes=tuple(names))
    assert find_record_folder(bundle, sensor) == "written-own-data-2"
    told = describe_for_page(bundle, sensor, "x")
    assert (told["classes"], told["digits"], told["rows"]) == (names, False, 9)
    assert find_record_folder(changed(source="../.."), sensor) == "written-9x12"


@pytest.mark.parametrize("shape", [(100,), (10, 10, 1), (10, 10, 3)])
def test_a_network_that_reads_no_sensor_is_refused(shape):
    with pytest.raises(UserError, match="shape"):
        find_sensor(changed(shape))
