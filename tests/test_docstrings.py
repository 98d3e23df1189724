"""Docstrings name parameters, types, modules and functions that exist."""

import ast
import builtins
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("deploy", "experiments", "fastloihi/src", "models", "pipeline", "stmnist")
# Types of other packages, which a docstring may name without an import.
OTHERS = {"LoihiBlock", "LoihiProbe", "Path"}


def read_modules():
    """Path and syntax tree of each module of the packages."""
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            yield path, ast.parse(path.read_text(encoding="utf-8"))


def find_names(tree):
    """Names that a module defines or imports."""
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef):
            names.add(node.name)
        elif isinstance(node, ast.alias):
            names.add((node.asname or node.name).rpartition(".")[2])
        elif isinstance(node, ast.Assign):
            names |= {target.id for target in node.targets if isinstance(target, ast.Name)}
    return names


def read_entries(docstring, section):
    """The (names, type) of each entry of a numpydoc section."""
    result = re.search(rf"^{section}\n-+\n(.*?)(?=^\w[\w ]*\n---|\Z)", docstring, re.M | re.S)
    for line in result[1].splitlines() if result else ():
        if entry := re.fullmatch(r"(\*{0,2}\w+(?:, \*{0,2}\w+)*)(?: : (.+))?", line):
            names = [name.strip("* ") for name in entry[1].split(",")]
            yield names, entry[2] or ""


def list_parameters(node):
    """Parameters of a function, or of the ``__init__`` and the fields of a class."""
    if isinstance(node, ast.ClassDef):
        names = set()
        for statement in node.body:
            if isinstance(statement, ast.AnnAssign):
                names.add(statement.target.id)
            elif isinstance(statement, ast.FunctionDef) and statement.name in (
                "__init__",
                "__new__",
            ):
                names |= list_parameters(statement)
        return names
    arguments = node.args
    every = [*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs]
    every += [one for one in (arguments.vararg, arguments.kwarg) if one]
    return {one.arg for one in every}


def list_attributes(node):
    """Fields, methods, properties, and attributes that a method sets, of a class."""
    names = list_parameters(node)
    for one in ast.walk(node):
        if isinstance(one, ast.FunctionDef):
            names.add(one.name)
        elif isinstance(one, ast.Name | ast.Attribute) and isinstance(one.ctx, ast.Store):
            names.add(one.id if isinstance(one, ast.Name) else one.attr)
    return names


def is_dataclass(node):
    """True if a class has the decorator of dataclasses."""
    return any("dataclass" in ast.unparse(one) for one in node.decorator_list)


def find_wrong_entries(tree, known):
    """Lines, names and types of docstrings that the code does not have."""
    known = known | find_names(tree) | OTHERS | set(dir(builtins))
    for node in ast.walk(tree):
        if not isinstance(node, ast.FunctionDef | ast.ClassDef):
            continue
        docstring = ast.get_docstring(node) or ""
        own = list_parameters(node)
        for names, _ in read_entries(docstring, "Parameters"):
            inherits = isinstance(node, ast.ClassDef) and node.bases
            if not inherits and not set(names) <= own:
                yield f"{node.lineno}: {node.name} has no parameter {', '.join(names)}"
        if isinstance(node, ast.ClassDef) and is_dataclass(node) and not node.bases:
            has = list_attributes(node)
            for names, _ in read_entries(docstring, "Attributes"):
                if not set(names) <= has:
                    yield f"{node.lineno}: {node.name} has no attribute {', '.join(names)}"
        for section in ("Parameters", "Attributes", "Returns", "Yields", "Raises"):
            for names, kind in read_entries(docstring, section):
                # A type alone is the whole line in Returns and Raises.
                text = kind or (names[0] if section in ("Returns", "Yields", "Raises") else "")
                for word in re.findall(r"(?<![\w.\"'])([A-Z][a-z]\w+)(?![\w.])", text):
                    if word not in known:
                        yield f"{node.lineno}: {node.name}: there is no {word}"


def is_defined(name):
    """Whether a dotted name leads to a package, a module, or what one defines itself."""
    path, below = ROOT, name.split(".")
    while below and (path / below[0]).is_dir():
        path /= below.pop(0)
    module = path / f"{below[0]}.py" if below else path
    path, below = (module, below[1:]) if module.is_file() else (path / "__init__.py", below)
    text = path.read_text(encoding="utf-8")
    return all(
        re.search(rf"^ *(?:(?:class|def) {word}\b|{word}(?::| =))", text, re.M) for word in below
    )


@pytest.fixture(scope="module")
def modules():
    """Path and syntax tree of each module."""
    return list(read_modules())


@pytest.mark.parametrize("package", PACKAGES)
def test_docstrings_name_parameters_and_types_that_exist(modules, package):
    classes = {
        node.name
        for _, tree in modules
        for node in ast.walk(tree)
        if isinstance(node, ast.ClassDef)
    }
    wrong = [
        f"{path.relative_to(ROOT)}:{text}"
        for path, tree in modules
        if path.is_relative_to(ROOT / package)
        for text in find_wrong_entries(tree, classes)
    ]
    assert not wrong, "\n".join(wrong)


def test_a_type_and_a_parameter_that_are_gone_are_found():
    source = '''
def move(way):
    """Move.

    Parameters
    ----------
    path : Motion
    way : Gone
    """
'''
    wrong = list(find_wrong_entries(ast.parse(source), {"Motion"}))
    assert len(wrong) == 2


def test_an_attribute_that_is_gone_is_found():
    source = '''
@dataclass(frozen=True)
class Motion:
    """A motion.

    Attributes
    ----------
    time_s : ndarray
    down : ndarray
    """

    time_s: np.ndarray
'''
    (wrong,) = find_wrong_entries(ast.parse(source), {"Motion"})
    assert "no attribute down" in wrong


@pytest.mark.parametrize("package", ["deploy", "experiments", "models", "pipeline", "stmnist"])
def test_names_in_docstrings_exist(package):
    """In a role, such as :mod:`pipeline.paper`, or as the type of a parameter."""
    for path in (ROOT / package).rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        dotted_name = r"(?:deploy|experiments|models|pipeline|stmnist)(?!\.pyz?\b)(?:\.\w+)+"
        for name in re.findall(rf"(?:`~?| : |of )({dotted_name})", text):
            assert is_defined(name), f"{path}: {name}"
