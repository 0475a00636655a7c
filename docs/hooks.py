"""What the pages get when they are built: formulas, helps, schemas, short names."""

import contextlib
import html
import io
import json
import re

from latex2mathml.converter import convert
from mkdocs.utils import get_relative_url

from phongfit import cli
from phongfit.files.calibrations import LightsRecord
from phongfit.files.encodings import ResponseRecord
from phongfit.files.fits import FitRecord
from phongfit.files.materials import MaterialFile
from phongfit.files.schema import SceneRecord, TruthRecord
from phongfit.maps.folder import MapsRecord

FORMULA = re.compile(
    r'<(?P<tag>span|div) class="arithmatex">'
    r"\\(?P<kind>[(\[])(?P<tex>.*?)\\[)\]]</(?P=tag)>",
    re.DOTALL,
)

FETCHED = "https://unpkg.com/iframe-worker/shim"

SCHEMAS = {
    "scene": SceneRecord,
    "truth": TruthRecord,
    "material": MaterialFile,
    "fit": FitRecord,
    "lights": LightsRecord,
    "response": ResponseRecord,
    "maps": MapsRecord,
}


def on_page_markdown(markdown, **_):
    """`{{ help }}` is what all commands say, `{{ schema fit }}` a file's schema."""
    if "{{ help }}" in markdown:
        markdown = markdown.replace("{{ help }}", _help())
    return re.sub(r"\{\{ schema (\w+) \}\}", _schema, markdown)


def on_page_content(content, **_):
    return FORMULA.sub(_formula, content)


def on_post_page(output, page, **_):
    """The theme would fetch this one script from elsewhere; ours does the same."""
    return output.replace(FETCHED, get_relative_url("worker.js", page.url))


def on_post_template(output_content, **_):
    return output_content.replace(FETCHED, "worker.js")


def on_env(env, config, **_):
    """Docstrings say [`fit`][] for what the reference calls phongfit.fit."""
    urls = config.plugins["autorefs"]._primary_url_map
    for identifier in [name for name in urls if name.startswith("phongfit.")]:
        parts = identifier.split(".")
        for short in (parts[-1], ".".join(parts[-2:])):
            urls.setdefault(short, urls[identifier])
    return env


def _help():
    parts = [_said("--help")]
    for command in cli.COMMANDS:
        parts.append(f"## phongfit {command}\n\n{_said(command, '--help')}")
    return "\n\n".join(parts)


def _said(*words):
    text = io.StringIO()
    with contextlib.redirect_stdout(text):
        cli.main(words)
    plain = re.sub(r"\x1b\[[0-9;]*m", "", text.getvalue())
    return f"```text\n{plain.strip()}\n```"


def _schema(found):
    record = SCHEMAS[found[1]]
    text = json.dumps(record.model_json_schema(), indent=2, ensure_ascii=False)
    return '??? note "JSON schema"\n\n' + "\n".join(
        f"    {line}" for line in f"```json\n{text}\n```".splitlines()
    )


def _formula(found):
    kind = "block" if found["kind"] == "[" else "inline"
    return convert(html.unescape(found["tex"]).strip(), display=kind)
