"""Rules of the house that no linter knows."""

import ast
import re
import shlex
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
MAX_FILE, MAX_FUNCTION, MAX_POSITIONAL = 400, 60, 5
SOURCES = sorted(
    path
    for folder in ("l3r", "data_prep", "benchmarks", "tests")
    for path in (ROOT / folder).rglob("*.py")
)
PRODUCT = [path for path in SOURCES if path.relative_to(ROOT).parts[0] in ("l3r", "data_prep")]
TEXTS = sorted(
    path
    for pattern in ("*.md", "docs/**/*.md", "configs/**/*.yaml", "demo/*", "Makefile")
    for path in ROOT.glob(pattern)
)


def name(path):
    return str(path.relative_to(ROOT))


def functions(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield node


@pytest.mark.parametrize("path", SOURCES, ids=name)
def test_files_and_functions_have_one_job(path):
    assert len(path.read_text().splitlines()) <= MAX_FILE
    long = [f.name for f in functions(path) if f.end_lineno - f.lineno + 1 > MAX_FUNCTION]
    assert not long


@pytest.mark.parametrize("path", PRODUCT, ids=name)
def test_functions_take_few_positional_arguments(path):
    def positional(function):
        names = [a.arg for a in function.args.posonlyargs + function.args.args]
        return len([n for n in names if n not in ("self", "cls")])

    # Callbacks take what the framework hands them.
    crowded = [
        f.name
        for f in functions(path)
        if positional(f) > MAX_POSITIONAL and not f.name.startswith("on_")
    ]
    assert not crowded


@pytest.mark.parametrize("path", PRODUCT, ids=name)
def test_transforms_are_called_b_from_a(path):
    banned = re.compile(r"\b(extrinsics?|c2w|w2c|cam2world|world2cam)\b", re.IGNORECASE)
    assert not banned.findall(path.read_text())


@pytest.mark.parametrize("path", PRODUCT, ids=name)
def test_no_file_is_named_after_nothing(path):
    assert path.stem not in ("utils", "util", "helpers", "helper", "misc", "common", "manager")


def test_every_public_function_of_the_inner_rooms_is_named_in_a_test():
    tests = "\n".join(p.read_text() for p in (ROOT / "tests").rglob("*.py"))
    rooms = ("geometry", "graph", "metrics", "data")
    missing = [
        f"{name(path)}: {node.name}"
        for room in rooms
        for path in (ROOT / "l3r" / room).rglob("*.py")
        for node in ast.parse(path.read_text()).body
        if isinstance(node, ast.FunctionDef)
        and not node.name.startswith("_")
        and not re.search(rf"\b{node.name}\b", tests)
    ]
    assert not missing


@pytest.mark.parametrize(
    "path", [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))], ids=name
)
def test_commands_in_the_documentation_parse(path):
    blocks = re.findall(r"```bash\n(.*?)```", path.read_text(), re.DOTALL)
    for line in "\n".join(blocks).replace("\\\n", " ").splitlines():
        words = shlex.split(line, comments=True)
        if words[:1] in (["l3r"], ["l3r-prep"]):
            check_parses(words)


def check_parses(words):
    """Parse a command line with the command's own parser, running nothing."""
    module = "l3r.cli.main" if words[0] == "l3r" else "data_prep.cli"
    code = (
        "import argparse, sys\n"
        f"from {module} import main\n"
        "parser = argparse.ArgumentParser\n"
        "for name in ('parse_args', 'parse_intermixed_args'):\n"
        "    def parse(self, *a, real=getattr(parser, name)):\n"
        "        real(self, *a)\n"
        "        sys.exit(0)\n"
        "    setattr(parser, name, parse)\n"
        "sys.exit(main(sys.argv[1:]))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, *words[1:]], capture_output=True, text=True, cwd=ROOT
    )
    assert done.returncode == 0, (words, done.stderr)


@pytest.mark.parametrize("path", TEXTS, ids=name)
def test_texts_name_files_that_exist(path):
    if path.suffix != ".md":
        return
    for target in re.findall(r"\]\(([^)#]+)\)", path.read_text()):
        if "://" not in target:
            assert (path.parent / target).exists(), target


def test_tests_that_texts_name_exist():
    written = {f.name for path in SOURCES for f in functions(path)}
    named = {test for path in TEXTS for test in re.findall(r"`(test_\w+)`", path.read_text())}
    assert named
    assert not named - written


@pytest.mark.slow
def test_the_wheel_holds_every_package_and_imports(tmp_path):
    build = [sys.executable, "-m", "build", "--wheel", "--outdir", str(tmp_path), str(ROOT)]
    done = subprocess.run(build, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        held = set(archive.namelist())
        archive.extractall(tmp_path / "site")
    missing = [name(path) for path in PRODUCT if name(path) not in held]
    assert not missing
    assert {"l3r/py.typed", "data_prep/py.typed", "l3r/export/report.html"} <= held
    assert {"data_prep/pages/check.html", "data_prep/pages/base.html"} <= held
    assert {"l3r/export/chart.html", "l3r/launch/sweep_report.html"} <= held
    assert "l3r/launch/score_chart.html" in held
    code = "import l3r.cli.main, data_prep.cli; print(l3r.__file__)"
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env={"PYTHONPATH": str(tmp_path / "site")},
    )
    assert done.returncode == 0, done.stderr
    assert str(tmp_path) in done.stdout
