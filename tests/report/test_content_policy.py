"""Every page that is written allows a browser its content, and nothing else."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field
from html.parser import HTMLParser
from pathlib import Path

import pytest

from sfm.comparison.significance import compare_results
from sfm.model.solution import Solution
from sfm.pipeline import run_survey
from sfm.products.batch.job import SurveyRow
from sfm.products.batch.table import batch_page
from sfm.report.output import write_result
from sfm.report.pages import content_policy, html, write_page
from sfm.survey.inputs.survey import read_survey
from tests.findings import findings_of
from tests.places import ROOT
from tests.surveys import write_photograph_survey
from tests.synthetic import make_network, seed_of

pytestmark = pytest.mark.usefixtures("plots")

EVIL = "<script>alert(1)</script><style>*{}</style><img src=https://example.org/x onerror=alert(1)>"
NOTHING = ["'none'"]


@dataclass
class Held(HTMLParser):
    """The content of a page, and its policy."""

    policies: list[str] = field(default_factory=list)
    inline: dict[str, list[str]] = field(default_factory=lambda: {"style": [], "script": []})
    sources: list[str] = field(default_factory=list)  # of what is loaded
    links: list[str] = field(default_factory=list)
    attributes: set[str] = field(default_factory=set)
    elements: set[str] = field(default_factory=set)
    inert: list[str] = field(default_factory=list)  # types of script elements that no browser runs
    before_policy: list[str] = field(default_factory=list)
    inside: str = ""

    def __post_init__(self) -> None:
        HTMLParser.__init__(self)

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        values = {name: value or "" for name, value in attributes}
        if tag == "meta" and values.get("http-equiv", "").lower() == "content-security-policy":
            self.policies.append(values["content"])
        elif not self.policies:
            self.before_policy.append(tag)
        self.elements.add(tag)
        self.attributes |= values.keys()
        self.sources += [values[name] for name in ("src", "srcset", "data", "poster") if name in values]
        self.links += [values["href"]] if "href" in values else []
        if tag == "script" and values.get("type"):
            self.inert.append(values["type"])
        elif tag in self.inline:
            self.inline[tag].append("")
            self.inside = tag

    def handle_endtag(self, tag: str) -> None:
        self.inside = "" if tag == self.inside else self.inside

    def handle_data(self, data: str) -> None:
        if self.inside:
            self.inline[self.inside][-1] += data


def held_by(text: str) -> Held:
    held = Held()
    held.feed(text)
    held.close()
    return held


def report_page(folder: Path) -> str:
    survey = read_survey(write_photograph_survey(folder / "survey", "report"))
    return write_result(findings_of(run_survey(survey)), folder / "out").read_text(encoding="utf-8")


def index_page(folder: Path) -> str:
    rows = (
        SurveyRow(EVIL, "/a/survey.toml", "javascript:alert(1)", "done", "good", 0.1, 0.1, 6, 6, 9, "agrees"),
        SurveyRow(EVIL, "/b/survey.toml", "b", "failed", reason=EVIL),
    )
    return html(batch_page(rows, EVIL))


def differences_page(folder: Path) -> str:
    network, truth = make_network(seed_of("policy"), model="opencv", images=5, points=20)
    found = compare_results(Solution(EVIL, network, truth), Solution("b", network, truth))
    return write_page(found, folder / "out", xyz=truth.points).read_text(encoding="utf-8")


PAGES = (report_page, index_page, differences_page)


@pytest.mark.parametrize("write", PAGES)
def test_a_page_allows_what_it_holds_and_nothing_else(write: Callable[[Path], str], tmp_path: Path) -> None:
    held = held_by(write(tmp_path))
    (policy,) = held.policies
    assert set(held.before_policy) <= {"html", "head", "meta"}  # a policy counts from its place on
    directives = {name: sources for name, *sources in map(str.split, policy.split(";"))}
    for kind, texts in held.inline.items():
        hashes = [base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in texts]
        assert directives.pop(f"{kind}-src") == ([f"'sha256-{one}'" for one in hashes] or NOTHING)
    beside = ["'self'"] if write is report_page else []  # photographs and crops lie beside the report
    assert directives.pop("img-src") == ["data:", *beside]
    assert set(held.inert) <= {"application/x-kolinear"}
    assert directives == dict.fromkeys(("default-src", "base-uri", "form-action"), NOTHING)
    assert held.inline["style"] and all(source.startswith("data:image/") for source in held.sources)
    assert not held.elements & {"link", "iframe", "object", "embed", "base", "form"}
    assert not [name for name in held.attributes if name == "style" or name.startswith("on")]
    assert not [link for link in held.links if ":" in link or link.startswith("//")]


def test_a_script_is_allowed_by_its_own_hash() -> None:
    script = "console.log('é')"
    one = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert f"script-src 'sha256-{one}';" in content_policy(["a {}"], [script])
    assert "'unsafe" not in content_policy(["a {}"], [script])


def test_all_pages_come_from_where_the_policy_is_written() -> None:
    """A page written elsewhere would have none."""
    folders = [ROOT / "sfm", ROOT / "adapters"]
    writers = [
        path.relative_to(ROOT).as_posix()
        for folder in folders
        for path in folder.rglob("*")
        if path.suffix in (".py", ".html", ".jinja", ".j2")
        and "<html" in path.read_text(encoding="utf-8").lower()
    ]
    served = "sfm/products/marking/page/mark.html"  # with a policy that its server sends
    assert sorted(writers) == [served, "sfm/report/templates/page.html"]
