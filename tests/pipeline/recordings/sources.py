"""Sources made by hand, and the errors of reading them."""

import pytest

from deploy.errors import UserError
from pipeline.recordings.files.reading import read_source
from tests.pipeline.handmade import archive


def put(path, contents):
    """Write a zip, or a folder for a path without suffix."""
    if path.suffix:
        archive(path, contents)
    else:
        for name, content in contents.items():
            (path / name).parent.mkdir(parents=True, exist_ok=True)
            (path / name).write_bytes(content)
    return path


def error(path, **how) -> str:
    """The only line of the error that reading a source ends with."""
    with pytest.raises(UserError) as caught:
        read_source(path, jobs=1, **how)
    (line,) = getattr(caught.value, "lines", [str(caught.value)])
    assert str(path) in line
    return line
