"""Formats of recordings, one module each; :data:`READERS` has the function for each file ending.

To add a format, write a function ``read(content, name)`` that gives an
:class:`~pipeline.recordings.formats.recording.EventRecording` or raises
:class:`~pipeline.recordings.formats.recording.BadRecording`, and enter it in :data:`READERS`.
:func:`~pipeline.recordings.formats.recording.make_recording` makes one of the columns x, y, t and p
and checks them; ``t_s``, ``t_ms`` and others name the unit of the times.  The ``name`` is for
readers of several endings; nothing but the ending may be read from it.  A package of yours calls
:func:`register_format` instead, in a plugin (:mod:`deploy.plugins`).
"""

from pathlib import PurePosixPath

from deploy.errors import UserError
from deploy.files import POINTER_PROBLEM, is_pointer
from deploy.terminal import escape_control
from pipeline.recordings.formats import atis, camera, csv, hdf5
from pipeline.recordings.formats.mat import read_mat
from pipeline.recordings.formats.npz import read_npy, read_npz
from pipeline.recordings.formats.recording import BadRecording

# Reader of the files with each ending, in lower case.
READERS = {
    ".mat": read_mat,
    ".npz": read_npz,
    ".npy": read_npy,
    **dict.fromkeys(csv.ENDINGS, csv.read_csv),
    **dict.fromkeys(camera.ENDINGS, camera.read_camera),
    **dict.fromkeys(atis.ENDINGS, atis.read_bin),
    **dict.fromkeys(hdf5.ENDINGS, hdf5.read_hdf5),
}

# Letters of the error of a reader that are repeated in a message.
MAX_ERROR_LETTERS = 200


def register_format(ending: str, read):
    """Add a format of recordings of another package.

    Parameters
    ----------
    ending : str
        Ending of the format's files, in lower case, such as ``".events"``.
    read : callable
        ``read(content, name)``, as of all formats.

    Raises
    ------
    ValueError
        The ending is not valid, or there is a format of it.
    """
    if not ending.startswith(".") or ending != ending.lower():
        raise ValueError(f"ending {ending!r}: must begin with a dot and be in lower case")
    if ending in READERS:
        raise ValueError(f"ending {ending!r}: there is a format of it already")
    READERS[ending] = read


def read_file(content: bytes, name: str):
    """Read one recording.

    Parameters
    ----------
    content : bytes
    name : str
        The file's name, whose ending determines the format, one of :data:`READERS`.

    Raises
    ------
    BadRecording
        The file has another format, or its content is not a recording; also where the reader raises
        any error that is not a `UserError`, since readers can be those of plugins.
    """
    if not content:
        raise BadRecording("is an empty file")
    if is_pointer(content):
        raise BadRecording(POINTER_PROBLEM)
    ending = PurePosixPath(name).suffix.lower()
    if ending not in READERS:
        raise BadRecording(
            f"has the ending {ending!r}; recordings end in {', '.join(sorted(READERS))}"
        )
    try:
        return READERS[ending](content, name)
    except (BadRecording, UserError):
        raise
    except Exception as error:
        text = escape_control(f"{type(error).__name__}: {error}")[:MAX_ERROR_LETTERS]
        raise BadRecording(f"cannot be read; the reader of {ending!r} raises {text}") from error
