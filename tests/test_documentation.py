"""README and docs/ say what is so: commands, options, settings, targets, paths, links, imports."""

import ast
import itertools
import re
import shlex
import subprocess

import pytest

import stmnist
from deploy.files import read_json
from deploy.targets.registry import TARGETS as DEPLOY_TARGETS
from experiments import licences, pictures
from experiments.document import FILES, with_parts
from models.ops import OPERATIONS, Pooling
from pipeline.commands.main import with_every_verb
from pipeline.recordings.formats import READERS
from pipeline.settings import Settings
from tests.command import ROOT, missing

README = ROOT / "README.md"
DOCS = sorted((ROOT / "docs").glob("*.md"))
PAGES = [
    *(README, *(ROOT / f"{name}.md" for name in ("CONTRIBUTING", "CHANGELOG", "SECURITY")), *DOCS),
    *(ROOT / "results" / "README.md", ROOT / "deploy" / "inrc" / "README.md"),
]
LONGEST_README = 190
TARGETS = [
    *("setup", "data", "train", "convert", "loihi-emulate", "loihi-hardware"),
    *("check", "benchmark", "report", "live", "test", "lint", "clean", "help"),
]
SUFFIXES = {"csv", "json", "md", "npz", "png", "py", "sbatch", "svg", "toml", "yaml"}

pages = pytest.mark.parametrize("page", PAGES, ids=lambda p: p.relative_to(ROOT).as_posix())


def commands():
    """Each command's words, such as ``"check run"``, with the command."""

    def walk(command, words):
        if hasattr(command, "commands"):
            for name, below in command.commands.items():
                yield from walk(below, [*words, name])
        else:
            yield " ".join(words), command

    return dict(walk(with_every_verb(), []))


def options(command):
    return {o for p in command.params for o in p.opts if o.startswith("--")} | {"--help"}


def read(page):
    """A page without its comments."""
    return re.sub(r"<!--.*?-->", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)


def blocks(text):
    """The contents of the fenced blocks of a page, each with its language."""
    return re.findall(r"^ *```(\w*)\n(.*?)^ *```$", text, re.MULTILINE | re.DOTALL)


def inline(text):
    """The code between single backticks, each on one line."""
    prose = re.sub(r"^ *```.*?^ *```$", "", text, flags=re.MULTILINE | re.DOTALL)
    return [" ".join(code.split()) for code in re.findall(r"(?<!`)`([^`]+)`(?!`)", prose)]


def shown(text, program):
    """The command lines of a program that a page shows, as lists of words without the program."""
    lines = [line for _, block in blocks(text) for line in block.replace("\\\n", " ").splitlines()]
    for line in itertools.chain(lines, inline(text)):
        if result := re.match(rf"\s*(?:\$ )?(?:\.venv/bin/)?{program}( .*)?$", line):
            yield shlex.split(result[1] or "", comments=True)


def test_there_is_a_readme_and_it_is_short():
    assert len(README.read_text(encoding="utf-8").splitlines()) <= LONGEST_README


@pytest.mark.parametrize("words", sorted(commands()))
def test_a_command_and_its_options_have_help(words):
    command = commands()[words]
    assert command.help
    assert command.help.strip()
    for parameter in command.params:
        assert getattr(parameter, "help", None), f"{words}: {parameter.name} has no help"


@pytest.mark.parametrize("name", FILES)
def test_what_is_generated_is_the_current_one(name):
    text = (ROOT / name).read_text(encoding="utf-8")
    assert text == with_parts(text), "run: python -m experiments document"


def find_rows_without_header(text):
    """Rows of tables outside of fenced blocks whose paragraph does not begin with a header."""
    prose = re.sub(r"^ *```.*?^ *```$", "", text, flags=re.MULTILINE | re.DOTALL)
    for paragraph in re.split(r"\n\s*\n", prose):
        rows = [line for line in paragraph.splitlines() if line.lstrip().startswith("|")]
        if rows and (len(rows) < 2 or not re.fullmatch(r"\s*\|(\s*:?-+:?\s*\|)+\s*", rows[1])):
            yield rows[0]


@pages
def test_each_row_of_a_table_has_its_header(page):
    assert list(find_rows_without_header(page.read_text(encoding="utf-8"))) == []


def test_an_empty_line_in_a_table_is_found():
    table = "| a | b |\n|---|---|\n| 1 | 2 |\n"
    assert list(find_rows_without_header(table)) == []
    assert list(find_rows_without_header(table + "\n| 3 | 4 |\n")) == ["| 3 | 4 |"]


@pages
def test_a_figure_does_not_begin_a_line(page):
    """Markdown ends the paragraph at a line that begins with a comment."""
    assert re.findall(r"^ *<!-- figure.*$", page.read_text(encoding="utf-8"), re.M) == []


def test_every_command_and_option_is_in_the_reference():
    text = read(ROOT / "docs" / "commands.md")
    for words, command in commands().items():
        (section,) = re.findall(rf"^#+ stmnist {words}[A-Z ]*\n(.*?)(?=^#|\Z)", text, re.M | re.S)
        assert options(command) - {"--help"} <= set(re.findall(r"--[\w-]+", section)), words


def test_every_public_name_is_in_the_reference():
    text = read(ROOT / "docs" / "api.md")
    for group, places in stmnist.GROUPS.items():
        section = text.partition(f"## {group}\n")[2].partition("\n## ")[0]
        shown = re.findall(r"^::: (.+)$", section, re.M)
        assert shown == [f"{module}.{name}" for name, module in places.items()]


def test_every_setting_is_in_the_docs():
    named = set(inline(read(ROOT / "docs" / "settings.md")))
    assert set(Settings().flatten()) <= named


def list_first_cells(page):
    """The code in the first cells of the rows of all tables of a page."""
    rows = re.findall(r"^\|(.*?)\|", read(ROOT / "docs" / page), re.MULTILINE)
    return [code for row in rows for code in inline(row)]


def test_every_format_has_a_row():
    assert set(READERS) <= set(list_first_cells("recordings.md"))


def test_every_target_has_a_row_and_is_in_the_glossary():
    assert set(DEPLOY_TARGETS) <= set(list_first_cells("bundle.md"))
    (row,) = re.findall(r"^\| target \|(.*)\|", read(ROOT / "docs" / "glossary.md"), re.MULTILINE)
    assert inline(row) == list(DEPLOY_TARGETS)


@pytest.mark.parametrize("layer", [*OPERATIONS.values(), Pooling], ids=lambda layer: layer.kind)
def test_every_notation_has_a_row(layer):
    codes = list_first_cells("training.md")
    assert any(layer.token.fullmatch(code) for code in codes), layer.examples


def test_a_part_without_an_end_is_refused():
    with pytest.raises(ValueError, match="settings"):
        with_parts("<!-- settings: made by experiments/document.py -->\n")


@pages
def test_commands_that_a_page_shows_exist(page):
    known = commands()
    groups = {" ".join(words.split()[:n]) for words in known for n in range(len(words.split()))}
    for words in shown(read(page), "stmnist"):
        plain = list(itertools.takewhile(lambda word: re.fullmatch(r"[a-z][a-z0-9]*", word), words))
        lengths = [n for n in (2, 1) if " ".join(plain[:n]) in known and len(plain) >= n]
        if lengths:
            command = known[" ".join(plain[: lengths[0]])]
            given = {word.partition("=")[0] for word in words if re.match("--[a-z]", word)}
            assert given <= options(command), words
        else:
            assert " ".join(plain) in groups, words


@pages
def test_targets_of_make_that_a_page_shows_exist(page):
    names = set(targets())
    for words in shown(read(page), "make"):
        asked = [word for word in words if "=" not in word]
        assert set(asked) <= names, words


@pages
def test_settings_that_a_page_names_exist(page):
    settings = Settings()
    text = read(page)
    names = set(re.findall(r"--(?:set|grid) ([\w.]+)=", text))
    sections = "|".join({name.partition(".")[0] for name in settings.flatten() if "." in name})
    for code in inline(text):
        result = re.match(rf"((?:{sections})\.(\w+))(?: = .*)?$", code)
        if result and result[2] not in SUFFIXES:
            names.add(result[1])
    assert names - {"section.name"} <= set(settings.flatten())


@pages
def test_paths_and_modules_that_a_page_names_exist(page):
    text = read(page)
    for code in inline(text):
        if re.fullmatch(r"(pipeline|models|deploy|tests|docs|results)/[\w./-]*", code):
            assert (ROOT / code).exists(), code
    for module in re.findall(r"python -m ((?:pipeline|deploy|tests)[\w.]*)", text):
        path = ROOT / module.replace(".", "/")
        assert path.is_dir() or path.with_suffix(".py").is_file(), module


def anchors(page):
    """The anchors of a page's headings, as GitHub makes them."""
    prose = re.sub(r"^ *```.*?^ *```$", "", read(page), flags=re.MULTILINE | re.DOTALL)
    seen = {}
    for title in re.findall(r"^#+ (.+)$", prose, re.MULTILINE):
        slug = re.sub(r"[^\w\- ]", "", title.strip().lower()).replace(" ", "-")
        yield slug + (f"-{seen[slug]}" if slug in seen else "")
        seen[slug] = seen.get(slug, 0) + 1


@pages
def test_links_within_the_repository_lead_somewhere(page):
    for link in re.findall(r"\]\(([^)\s]+)\)", read(page)):
        if re.match(r"\w+:", link):
            continue
        name, _, anchor = link.partition("#")
        target = (page.parent / name).resolve() if name else page
        assert target.exists(), link
        assert target.is_relative_to(ROOT), link
        if anchor:
            assert anchor in set(anchors(target)), link


def defined(module):
    """The names that a module of ours defines or imports at its top, without importing it."""
    path = ROOT / module.replace(".", "/")
    path = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ImportFrom):
            yield from (alias.asname or alias.name for alias in node.names)
        elif isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            yield node.name
        elif isinstance(node, (ast.Assign, ast.AnnAssign)):
            ends = node.targets if isinstance(node, ast.Assign) else [node.target]
            yield from (end.id for end in ends if isinstance(end, ast.Name))
    if path.name == "__init__.py":
        yield from (below.stem for below in path.parent.iterdir())


@pages
def test_what_a_page_imports_in_python_exists(page):
    for language, block in blocks(read(page)):
        if language != "python":
            continue
        for node in ast.walk(ast.parse(block)):
            if not isinstance(node, ast.ImportFrom):
                continue
            names = {alias.name for alias in node.names}
            if node.module == "stmnist":
                assert names <= set(stmnist.__all__)
            elif re.match("pipeline|models|deploy", node.module):
                assert names <= set(defined(node.module)), node.module


def targets():
    """The targets of the Makefile that are no files."""
    return re.findall(r"^([a-z][\w-]*):", (ROOT / "Makefile").read_text(), re.MULTILINE)


def make(*words):
    """What make prints; below `make test` it would also say which directory it enters."""
    command = ["make", "--no-print-directory", *words]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)


def test_the_makefile_lists_all_its_targets():
    done = make("help")
    listed = {line.split()[1]: line.split(None, 2)[2] for line in done.stdout.splitlines()}
    assert set(listed) == set(targets())
    assert all(listed.values())
    (phony,) = re.findall(r"^\.PHONY: (.*)$", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert set(phony.split()) == set(targets())
    assert set(TARGETS) <= set(listed)


def test_make_without_a_target_is_help():
    done = make()
    assert "make loihi-emulate" in done.stdout


@pytest.mark.parametrize("target", TARGETS)
def test_a_target_of_the_makefile_calls_a_command_that_exists(target):
    done = make("-n", "-o", "setup", "-o", ".venv/installed", target, "DATA=x y.zip", "SEED=3")
    for called in re.findall(r"^\.venv/bin/stmnist (.*)$", done.stdout, re.M):
        assert any(called.startswith(words) for words in commands()), called


@pytest.mark.parametrize("target", ["train", "ladder", "benchmark"])
def test_settings_with_blanks_are_passed_on(target, tmp_path):
    """Each command is replaced by one that prints its arguments."""
    tool = tmp_path / "python"
    tool.write_text("#!/bin/sh\nprintf '%s\\n' \"$@\"\n")
    tool.chmod(0o755)
    given = 'SET=cnn.epochs=5 data.source=my "own" events seed=3'
    target = {"ladder": "loihi-emulate"}.get(target, target)
    done = make("-o", "setup", target, given, f"STMNIST={tool}", f"BIN={tmp_path}")
    (word,) = [line for line in done.stdout.splitlines() if "epochs" in line]
    assert word == given.removeprefix("SET=")


@pytest.mark.parametrize("is_run", [True, False])
def test_only_a_run_is_removed(tmp_path, is_run):
    folder = tmp_path / "my own"
    folder.mkdir()
    (folder / "thesis.txt").write_text("years")
    if is_run:
        (folder / "experiment.toml").touch()
    command = ["make", "clean", f"RUN={folder}"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == (0 if is_run else 2)
    assert folder.exists() is not is_run
    assert is_run or "experiment.toml" in done.stderr


@pytest.mark.parametrize("target", TARGETS)
def test_blanks_in_a_path_do_not_part_it(target):
    given = {"DATA": "my events  set.zip", "RUN": "my runs/a b", "INPUT": "events"}
    words = ["-n", "-o", "setup", "-o", ".venv/installed", target]
    done = make(*words, *(f"{name}={value}" for name, value in given.items()))
    for line in done.stdout.splitlines():
        if line.startswith((".venv/bin/stmnist ", "rm ")):
            _, arguments = line.split(" ", 1)
            said = ["sh", "-c", rf"printf '%s\n' {arguments}"]
            words = subprocess.run(said, capture_output=True, text=True, check=True).stdout
            for word in words.splitlines():
                if "set.zip" in word:
                    assert word == given["DATA"]
                if "runs" in word or "a b" in word:
                    assert word == "my runs/table2" or f"{word}/".startswith("my runs/a b/")
                assert word not in {"my", "set.zip", "runs/a", "b"}


def test_a_wrong_python_is_one_clear_line(tmp_path):
    (tmp_path / "fastloihi").mkdir()
    pins = ("pyproject.toml", "fastloihi/pyproject.toml", "constraints.txt")
    for name in ("Makefile", "setup.sh", *pins):
        (tmp_path / name).write_bytes((ROOT / name).read_bytes())
    done = subprocess.run(
        ["make", "setup", "PYTHON=no-such-python"], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 2
    assert missing(done.stderr.splitlines()[0], "3.11", "3.12", "3.13") == []


def test_an_audit_leaves_out_what_security_explains():
    explained = re.findall(r"^- \*\*(CVE-\d+-\d+)\*\*", read(ROOT / "SECURITY.md"), re.MULTILINE)
    assert explained
    assert re.findall(r"--ignore-vuln (\S+)", make("-n", "audit").stdout) == explained


def test_pictures_show_what_there_is():
    """Otherwise: ``python -m experiments pictures``."""
    assert read_json(ROOT / "docs" / "pictures.json", "") == pictures.compute_stamps()


def test_the_page_on_licences_names_every_condition():
    """The table is generated, so that it is compared with the metadata by the test of all parts."""
    page = read(ROOT / "docs" / "licences.md").lower()
    restricted = licences.list_restricted_packages()
    assert {"nengo", "nengo-dl", "nengo-extras"} <= set(restricted)
    assert missing(page, *(f"|{name}|" for name in restricted)) == []
    assert "gpl" in licences.read_licence("nengo").lower()
    faq = read(ROOT / "docs" / "faq.md")
    assert missing(faq, "GPLv2", "non-commercial", "licences.md") == []
