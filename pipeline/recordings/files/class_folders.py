"""The part of a published split and the class of each file, by its folders and its name."""

from collections import Counter
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from deploy.errors import UserError
from deploy.tables import list_names
from pipeline.recordings.files.messages import shorten

# Part of a published split, by the name of a folder in lower case.
PART_OF_FOLDER = {"train": "train", "training": "train", "test": "test", "testing": "test"}

# Names of folders with validation samples, in lower case.
VALIDATION = ("validation", "valid", "val", "dev")

# What stands before the class in the name of a file.
LABEL_MARK = "_label_"


class MisplacedFile(ValueError):
    """Raised for a file without a part or class; the message has the reason."""


@dataclass(frozen=True)
class ClassFolders:
    """The place of the classes in a source.

    Attributes
    ----------
    around : PurePosixPath
        The folder that contains train and test, or the folders of the classes.
    is_published : bool
        True if it contains train and test.
    has_numbers : bool
        True if most labels in names of files are whole numbers.
    """

    around: PurePosixPath
    is_published: bool
    has_numbers: bool


def find_class_folders(path: Path, recordings: list) -> ClassFolders:
    """Find the folders of the classes.

    Parameters
    ----------
    path : Path
        Path of the source.
    recordings : list of PurePosixPath
        Paths of the recordings in it.

    Raises
    ------
    UserError
        There are several data sets, or a folder of validation samples.
    """
    _require_one_data_set(path, recordings)
    around = _find_folders_around(recordings)
    inside = [m.relative_to(around) for m in recordings if m.is_relative_to(around)]
    is_published = _are_part_folders(inside)
    tops = {member.parts[0] for member in inside if len(member.parts) > 1}
    validation = [top for top in tops if top.lower() in VALIDATION]
    if is_published and validation:
        raise UserError(
            f"{path}: has a folder {validation[0]!r} next to train and test; move its recordings "
            "to train, from which validation samples are drawn, or move it away"
        )
    labels = [label for label in map(read_label, recordings) if label is not None]
    n_numbers = sum(label.isdecimal() for label in labels)
    return ClassFolders(around, is_published, 2 * n_numbers > len(labels))


def read_label(member: PurePosixPath) -> str | None:
    """The class in a file's name, ``..._label_<class>``; None if there is none."""
    _, mark, label = member.stem.rpartition(LABEL_MARK)
    return label if mark else None


def _are_part_folders(members):
    """True if train and test are the top folders, and the classes are below or in the names."""
    tops = {
        PART_OF_FOLDER.get(member.parts[0].lower())
        for member in members
        if len(member.parts) > (2 if read_label(member) is None else 1)
    }
    return len(tops - {None}) == 2


def _require_one_data_set(path, recordings):
    """Refuse a folder with several data sets, each with train and test."""
    parts = {}
    for member in recordings:
        folders = member.parts[:-1]
        depth = next((i for i, name in enumerate(folders) if name.lower() in PART_OF_FOLDER), None)
        if depth is not None:
            data_set = PurePosixPath(*folders[:depth])
            parts.setdefault(data_set, set()).add(PART_OF_FOLDER[folders[depth].lower()])
    roots = sorted(map(str, parts))
    if len(roots) > 1 and any(len(names) == 2 for names in parts.values()):
        is_folder = path.is_dir()
        remedy = f"give one of them: --data {path / roots[0]}" if is_folder else "give one of them"
        raise UserError(
            f"{path}: has several data sets with train or test: "
            f"{list_names(map(shorten, roots))}; {remedy}"
        )


def _find_folders_around(recordings) -> PurePosixPath:
    """The folders around most recordings, inside of which are the folders of the classes."""
    parents = {member.parent for member in recordings}
    if len(parents) == 1 and None not in map(read_label, recordings):
        return parents.pop()
    around = PurePosixPath()
    while True:
        inside = [m.relative_to(around) for m in recordings if m.is_relative_to(around)]
        tops = Counter(member.parts[0] for member in inside if len(member.parts) > 2)
        if _are_part_folders(inside) or not tops:
            return around
        top, number = tops.most_common(1)[0]
        if 2 * number <= len(recordings):
            return around
        around /= top


def find_part_and_class(member: PurePosixPath, class_folders: ClassFolders, labelled=True) -> tuple:
    """The part of a published split and the class of a recording, each empty without one.

    Parameters
    ----------
    member : PurePosixPath
        Path of the recording in the source.
    class_folders : ClassFolders
    labelled : bool
        False if a recording need not have a class.

    Raises
    ------
    MisplacedFile
        It has none, or is not where the others are.
    """
    if not member.is_relative_to(class_folders.around):
        raise MisplacedFile(f"is not in {class_folders.around}, as the others are; move it")
    folders = member.relative_to(class_folders.around).parts[:-1]
    part = ""
    if class_folders.is_published:
        part = PART_OF_FOLDER.get(folders[0].lower(), "") if folders else ""
        if not part:
            raise MisplacedFile("is neither in train nor in test, as the others are; move it away")
        folders = folders[1:]
    if len(folders) > 1:
        raise MisplacedFile("is in a folder inside that of a class; move it")
    label = read_label(member)
    if label is not None:
        _require_class_label(label, folders, class_folders)
    if folders:
        return part, folders[0]
    if label is None and labelled:
        raise MisplacedFile(
            "is not in a folder of a class; give the folder above, or make a folder for it"
        )
    return part, label or ""


def _require_class_label(label, folders, class_folders):
    """Refuse a label in a file's name that is no class, or another one than the folder's."""
    if not label.strip() or (class_folders.has_numbers and not label.isdecimal()):
        raise MisplacedFile(
            f"has the label {label!r} in its name, which is no class; correct the name"
        )
    if not folders or label == folders[0]:
        return
    are_numbers = label.isdecimal() and folders[0].isdecimal()
    if not are_numbers or int(label) != int(folders[0]):
        raise MisplacedFile(
            f"is in the folder of class {folders[0]!r}, and has the label {label!r} in its name; "
            "move it or correct the name"
        )
