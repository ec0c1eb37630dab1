"""The documentation as a site: it builds without a warning, and its pages open offline."""

from __future__ import annotations

import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest

pytestmark = pytest.mark.soak

ROOT = Path(__file__).resolve().parents[2]
FETCHING = {"script": "src", "img": "src", "link": "href", "iframe": "src", "source": "src"}


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    pytest.importorskip("furo", reason="the documentation needs the extra 'docs'")
    folder = tmp_path_factory.mktemp("site")
    result = subprocess.run(
        [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "docs", str(folder)],
        cwd=ROOT, capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    return folder


class Fetched(HTMLParser):
    """What a page loads by itself."""

    def __init__(self):
        super().__init__()
        self.found = []

    def handle_starttag(self, tag, attrs):
        given = dict(attrs)
        if tag in FETCHING and given.get("rel") not in ("canonical", "search", "index"):
            self.found.append(given.get(FETCHING[tag]) or "")


def test_no_page_fetches_anything_from_elsewhere(site):
    pages = sorted(site.rglob("*.html"))
    assert len(pages) > 15
    for page in pages:
        reader = Fetched()
        reader.feed(page.read_text(encoding="utf-8"))
        assert not [link for link in reader.found if re.match(r"(https?:)?//", link)], page


def test_equations_are_drawn_by_the_browser_itself(site):
    text = "".join(page.read_text(encoding="utf-8") for page in site.rglob("*.html"))
    assert "<math" in text
    assert "MathJax" not in text


def test_every_document_is_in_the_table_of_contents(site):
    index = (site / "index.html").read_text(encoding="utf-8")
    for document in sorted((ROOT / "docs").rglob("*.md")):
        page = document.relative_to(ROOT / "docs").with_suffix(".html").as_posix()
        assert page == "index.html" or f'href="{page}"' in index, document
