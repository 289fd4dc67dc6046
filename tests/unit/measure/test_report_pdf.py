"""The report as PDF: whole, the same for the same page, long tables continued, and no text breaks it."""

from __future__ import annotations

import base64
import re
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from drivers.errors import FileError
from measure.plots import svg_of
from measure.report_page import Page, Picture, Row, Table
from measure.report_pdf import pdf_bytes, write_pdf


def draw(figure: Any) -> None:
    figure.subplots().plot([0, 1], [0, 1])


def page(n_rows: int = 3, text: str = "plain") -> Page:
    table = Table("Lengths", "lead", ("length", "error"), tuple((f"A-{i} {text}", f"{i / 1000:+.3f}") for i in range(n_rows)))
    row = Row("centre rms", text, "1.0 mm", "0.1 mm", "0.2 mm", "conform", "good")
    return Page(
        title=f"cell {text}",
        headline="Conform",
        sentence=text,
        tone="good",
        remarks=(text,),
        result_lead=text,
        rows=(row,),
        reasons=(text,),
        next_steps=(text,),
        tables=(table, Table("Nothing", "lead", ("a", "b"), ())),
        pictures=(Picture("Course", "caption", svg_of(draw, salt="t", size=(3, 2))),),
        calibration_rows=(row,),
        identity=(("calibration", "0123456789abcdef" * 4), ("none", "")),
        created_utc="2026-11-22 10:00 UTC",
        software="spherecal",
        decision_rule="rule",
    )


def n_pages(data: bytes) -> int:
    return len(re.findall(rb"/Type /Page\b", data))


def test_it_is_a_pdf_and_the_same_page_gives_the_same_bytes() -> None:
    data = pdf_bytes(page())
    assert data.startswith(b"%PDF-")
    assert data.rstrip().endswith(b"%%EOF")
    assert data == pdf_bytes(page())
    assert b"DejaVuSans" in data


def test_long_tables_go_on_over_pages() -> None:
    few, many = n_pages(pdf_bytes(page())), n_pages(pdf_bytes(page(n_rows=200)))
    assert few <= 2
    assert many >= few + 3


@pytest.mark.parametrize("text", ["<b>&</i> %s \\ <script>", "Ü–²°µ≥→ θ", "x" * 400, "\x00\x07", ""])
def test_no_text_breaks_it(text: str) -> None:
    assert pdf_bytes(page(text=text)).startswith(b"%PDF-")


def test_a_remark_for_every_page_is_on_every_page() -> None:
    plain, marked = (pdf_bytes(replace(page(n_rows=200), on_every_page=remark)) for remark in ("", "training data"))
    red = re.compile(rb"\.701961 \.14902 \.117647 rg")

    def marks(data: bytes) -> int:
        return sum(bool(red.search(stream)) for stream in streams(data))

    assert marks(plain) == 0
    assert marks(marked) == n_pages(marked) == n_pages(plain)


def streams(data: bytes) -> list[bytes]:
    """Contents of the pages, unpacked."""
    found = []
    for packed in re.findall(rb"/ASCII85Decode /FlateDecode[^>]*>>\s*stream\r?\n(.*?)endstream", data, re.S):
        unpacked = zlib.decompress(base64.a85decode(packed.strip().removesuffix(b"~>")))
        found += [unpacked] if b" Tf" in unpacked else []
    return found


def test_it_appears_whole_or_not_at_all(tmp_path: Path) -> None:
    assert write_pdf(tmp_path / "r.pdf", page()).read_bytes().startswith(b"%PDF-")
    with pytest.raises(FileError):
        write_pdf(tmp_path / "none" / "r.pdf", page())
