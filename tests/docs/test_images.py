"""The documentation's pictures: each can be made anew, and none is left over."""

from pathlib import Path

from docs.make_images import GALLERY, IMAGES, PICTURES

ROOT = Path(__file__).resolve().parents[2]


def test_every_picture_has_a_recipe_and_a_page():
    pictures = {path.name for path in [*IMAGES.iterdir(), *GALLERY.glob("*.png")]}
    assert pictures == set(PICTURES)
    pages = [ROOT / "README.md", *ROOT.glob("docs/**/*.md"), *ROOT.glob("examples/**/*.md")]
    text = "".join(page.read_text("utf-8") for page in pages)
    assert [name for name in pictures if f"{name})" not in text] == []
