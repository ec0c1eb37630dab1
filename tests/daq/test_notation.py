"""Names, units and numbers as HTML, LaTeX and figures write them."""

import html
from html.parser import HTMLParser

import pytest
from hypothesis import given
from hypothesis import strategies as st

from daq import notation
from sysid.judging.phrases import sized


@pytest.mark.parametrize(
    ("name", "as_html", "as_tex"),
    [
        ("omega_dm", "<i>ω</i><sub>dm</sub>", r"$\omega_{\mathrm{dm}}$"),
        ("alpha1", "<i>α</i><sub>1</sub>", r"$\alpha_{\mathrm{1}}$"),
        ("R_b / L_b", "<i>R</i><sub>b</sub> / <i>L</i><sub>b</sub>",
         r"$R_{\mathrm{b}}$ / $L_{\mathrm{b}}$"),
        ("z(0)", "<i>z</i>(0)", "$z(0)$"),
        ("a^2", "<i>a</i><sup>2</sup>", "$a$$^{2}$"),
        ("current_motor", "current_motor", r"current\_motor"),
        ("50%_&<x>", "50%_&amp;&lt;<i>x</i>&gt;", r"50\%\_\&\textless{}$x$\textgreater{}"),
    ],
)  # fmt: skip
def test_names_become_symbols_and_words_stay(name, as_html, as_tex):
    assert notation.html(name) == as_html
    assert notation.tex(name) == as_tex


@pytest.mark.parametrize(
    ("unit", "text", "tex"),
    [
        ("N*m*s/(rad*A)", "N·m·s/(rad·A)", r"N\,m\,s/(rad\,A)"),
        ("kg*m^2", "kg·m²", r"kg\,m$^{2}$"),
        ("ohm", "Ω", r"\ensuremath{\Omega}"),
        ("1", "", ""),
    ],
)
def test_units(unit, text, tex):
    assert notation.unit_text(unit) == text
    assert notation.unit_tex(unit) == tex


def test_numbers():
    assert notation.number_html("-5.4e-4") == "−5.4×10<sup>−4</sup>"
    assert notation.number_tex("-5.4e-4") == r"$-5.4\times10^{-4}$"
    assert notation.number_tex("120") == "$120$"


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.0996, "0.100"), (9.96e-5, "1.00e-4"), (9.94e-5, "9.9e-5"), (-9.96e-7, "-1.00e-6")],
)
def test_a_number_that_is_rounded_up_to_a_power_of_ten_keeps_its_last_place(value, text):
    assert notation.number(value, 2) == text


class _Text(HTMLParser):
    def __init__(self):
        super().__init__(convert_charrefs=True)
        self.text, self.tags = "", set()

    def handle_data(self, data):
        self.text += data

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)


@given(st.text(st.characters(codec="utf-8", exclude_categories=["Cc", "Cs"]), max_size=30))
def test_no_name_brings_html_or_latex_of_its_own(name):
    page = _Text()
    page.feed(notation.html(name))
    page.close()
    assert page.tags <= {"i", "sub", "sup"}
    if not any(sign in name for sign in "_^-") and not any(map(str.isalnum, name)):
        assert page.text == html.unescape(html.escape(name))
    tex = notation.escape_tex(name)
    for sign in "%&#_":
        assert tex.count(sign) == tex.count("\\" + sign)


def test_equations_have_derivatives_and_no_signs_of_products():
    assert notation.equation("L_m di_m/dt = -R_m*i_m - |z|^2") == (
        "<i>L</i><sub>m</sub> d<i>i</i><sub>m</sub>/d<i>t</i> = "
        "−<i>R</i><sub>m</sub>\u2009<i>i</i><sub>m</sub> − |<i>z</i>|<sup>2</sup>"
    )


@given(
    st.floats(1e-11, 1e8) | st.floats(-1e8, -1e-11),
    st.sampled_from(["A", "N*m", "N*m*s/rad", "s", "kg*m^2", "m^2", "1/s", "1"]),
)
def test_sentences_have_the_multiple_that_tables_have(value, unit):
    scale, multiple = notation.engineering(value, unit)
    number, _, behind = sized(value, unit).partition(" ")
    assert behind == ("" if multiple == "1" else multiple)
    assert float(number) == pytest.approx(scale * value, rel=6e-3)
