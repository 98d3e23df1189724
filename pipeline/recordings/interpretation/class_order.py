"""The order of the classes: ``classes.txt``, or by name."""

from pipeline.recordings.sensor import DIGITS, make_class_sort_key

CLASS_ORDER = "classes.txt"


def order_classes(names: set, content: bytes | None) -> tuple:
    """Put the names of the classes into the order of their labels.

    Parameters
    ----------
    names : set of str
    content : bytes or None
        Content of ``classes.txt``, a name in each line; None without the file.

    Returns
    -------
    classes : tuple of str
        In the order of the file if it names each class once; otherwise sorted, numbers by value.
        Digits are always sorted.
    remark : str
        Why the file is not used; empty if it is, or without it.
    """
    by_name = tuple(sorted(names, key=make_class_sort_key))
    if content is None:
        return by_name, ""
    lines = [line.strip() for line in content.decode("utf-8-sig", "replace").splitlines()]
    listed = tuple(line for line in lines if line in names)
    if missing := sorted(names - set(listed)):
        return by_name, f"{CLASS_ORDER} is not used, because it has no line {missing[0]!r}"
    if len(listed) > len(names):
        return by_name, f"{CLASS_ORDER} is not used, because it names a class twice"
    if names <= set(DIGITS) and listed != by_name:
        return by_name, f"{CLASS_ORDER} is not used, because digits are labels in their own order"
    return listed, ""
