"""The documentation: its code runs as it stands, and names all that is public."""

import contextlib
import json
import re
import shlex
import shutil
from pathlib import Path
from typing import Any

import pytest

import phongfit as pf
from phongfit import cli
from phongfit.moved import MOVED

ROOT = Path(__file__).parents[1]
PAGES = sorted((ROOT / "docs").rglob("*.md"))
BLOCK = re.compile(r"^```(python|sh|text)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
INDENTED = re.compile(r"^ {4,}(?:phongfit|pip|python|import|from) ", re.MULTILINE)


def name_of(page: Path) -> str:
    return page.relative_to(ROOT / "docs").as_posix()


def blocks(page: Path) -> list[tuple[str, str]]:
    """Language and code of what a reader types, from top to bottom.

    Among `text` are commands of whoever has photographs or a cluster.
    """
    return BLOCK.findall(page.read_text(encoding="utf-8"))


def lines(code: str) -> list[list[str]]:
    """The words of each line of a shell."""
    joined = code.replace("\\\n", " ").splitlines()
    found = [shlex.split(line, comments=True) for line in joined]
    return [words for words in found if words]


TYPED = [page for page in PAGES if blocks(page)]
RUN = [page for page in TYPED if {"python", "sh"} & dict(blocks(page)).keys()]


def test_what_is_typed_is_there():
    """Python compiles, and commands have the options that they are given."""
    for page in TYPED:
        for language, code in blocks(page):
            if language == "python":
                compile(code, name_of(page), "exec")
                continue
            for program, *words in lines(code):
                if program == "phongfit":
                    cli._parse(cli._load(words[0]), words[1:], f"phongfit {words[0]}")


@pytest.mark.slow
@pytest.mark.parametrize("page", RUN, ids=name_of)
def test_pages_run_as_they_stand(page, tmp_path, capsys):
    """In an empty folder; what installs something is left to whoever installs."""
    if page.stem == "cluster":
        pytest.importorskip("distributed")
    names: dict[str, Any] = {}
    with contextlib.chdir(tmp_path):
        for language, code in blocks(page):
            if language == "python":
                exec(compile(code, name_of(page), "exec"), names)
            for program, *words in lines(code) if language == "sh" else ():
                if program == "cp":
                    shutil.copytree(ROOT / words[1], words[2])
                if program == "phongfit":
                    assert cli.main(words) == 0, (words, capsys.readouterr().err)


def test_all_code_stands_in_fences():
    """What is merely indented, no test would see."""
    texts = {page: page.read_text(encoding="utf-8") for page in PAGES}
    bare = [page for page in PAGES if INDENTED.search(BLOCK.sub("", texts[page]))]
    assert bare == []


def test_every_public_name_has_its_place():
    text = "\n".join(page.read_text(encoding="utf-8") for page in PAGES)
    documented = set(re.findall(r"^::: phongfit\.([\w.]+)$", text, re.MULTILINE))
    modules = {"geometry": dir(pf.geometry), "rendering": dir(pf.rendering)}
    assert {name for name in documented if "." not in name} == {*dir(pf)} - {*modules}
    for module, names in (modules | {m: n.split() for m, n in MOVED.items()}).items():
        assert {f"{module}.{name}" for name in names} <= documented


def test_every_format_has_its_schema():
    """Files that are records are shown as such; a prediction is written alone."""
    sources = [
        path.read_text(encoding="utf-8") for path in (ROOT / "phongfit").rglob("*.py")
    ]
    kinds = re.findall(r'format: Literal\["phongfit (\w+)"\]', "\n".join(sources))
    text = (ROOT / "docs/reference/formats.md").read_text(encoding="utf-8")
    assert set(re.findall(r"{{ schema (\w+) }}", text)) == set(kinds)
    kept = ROOT / "tests/data/records/prediction_version_1.json"
    record = json.loads(kept.read_text(encoding="utf-8"))
    part = text.partition("## A prediction")[2]
    assert set(record) - {"format", "version"} <= set(re.findall(r"`(\w+)`", part))


def test_every_page_is_in_the_table_of_contents():
    text = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    assert sorted(re.findall(r"\S+\.md$", text, re.MULTILINE)) == sorted(
        name_of(page) for page in PAGES
    )
