"""Fixtures of the deployment tests."""

import pytest

from tests.deploy import standin


@pytest.fixture
def nxsdk(monkeypatch):
    """The NxSDK stand-in, in the place of NxSDK; faults start from none."""
    yield standin.install(monkeypatch)
    standin.uninstall()
