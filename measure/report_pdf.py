"""The report as PDF: the same page, for archives and signatures."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.sax.saxutils import escape

from drivers.files.disk import write_atomic
from measure.plots import png_of
from measure.report_page import Page, Row, Table

if TYPE_CHECKING:
    from reportlab.lib.styles import ParagraphStyle
    from reportlab.platypus import Flowable

_TONES = {"good": "#15803d", "unsure": "#a16207", "bad": "#b3261e"}
_SOFT, _LINE, _BEFORE, _AFTER = "#6b7280", "#e5e7eb", "#c2571a", "#1f6f8b"
_MARGIN_PT, _WIDTH_PT = 48.0, 595.28 - 2 * 48.0
_SMALL_WIDTH_PT = _WIDTH_PT / 2 - 6
_FONT, _BOLD = "DejaVuSans", "DejaVuSans-Bold"
_BREAK_AFTER = re.compile(r"(\S{34})(?=\S)")


def write_pdf(path: str | Path, page: Page) -> Path:
    """Write the PDF of a page; it appears whole or not at all, and the same page gives the same bytes.

    Raises:
        FileError: the place cannot be written.
    """
    write_atomic(path, pdf_bytes(page))
    return Path(path)


def pdf_bytes(page: Page) -> bytes:
    """A4, tables continued over pages with their heads, every page with title, number and digest."""
    from reportlab.platypus import SimpleDocTemplate

    _register_fonts()
    stream = io.BytesIO()
    document = SimpleDocTemplate(
        stream,
        pagesize=(595.28, 841.89),
        leftMargin=_MARGIN_PT,
        rightMargin=_MARGIN_PT,
        topMargin=46,
        bottomMargin=52,
        title=page.title,
        author=page.software,
        subject=page.headline,
        invariant=1,
    )

    def foot(canvas: Any, template: Any) -> None:
        canvas.saveState()
        canvas.setFont(_FONT, 7.5)
        canvas.setFillColor(_SOFT)
        canvas.drawString(_MARGIN_PT, 30, f"{page.title}  ·  {page.created_utc}  ·  {page.software}")
        canvas.drawRightString(595.28 - _MARGIN_PT, 30, str(template.page))
        if page.on_every_page:
            canvas.setFont(_BOLD, 8)
            canvas.setFillColor(_TONES["bad"])
            canvas.drawString(_MARGIN_PT, 841.89 - 30, page.on_every_page)
        canvas.restoreState()

    document.build(_story(page), onFirstPage=foot, onLaterPages=foot)
    return stream.getvalue()


def _register_fonts() -> None:
    """Fonts that hold every character of our texts; they come with matplotlib."""
    import matplotlib as mpl
    from reportlab.pdfbase import pdfmetrics
    from reportlab.pdfbase.ttfonts import TTFont

    folder = Path(mpl.get_data_path()) / "fonts" / "ttf"
    for name in (_FONT, _BOLD):
        if name not in pdfmetrics.getRegisteredFontNames():
            pdfmetrics.registerFont(TTFont(name, str(folder / f"{name}.ttf")))


def _style(name: str, size: float, *, colour: str = "#1f2937", bold: bool = False, after: float = 3.0, right: bool = False) -> ParagraphStyle:
    from reportlab.lib.styles import ParagraphStyle

    font = _BOLD if bold else _FONT
    return ParagraphStyle(name, fontName=font, fontSize=size, leading=1.32 * size, textColor=colour, spaceAfter=after, alignment=2 if right else 0)


def _text(text: str, style: ParagraphStyle) -> Flowable:
    from reportlab.platypus import Paragraph

    return Paragraph(escape(_BREAK_AFTER.sub("\\1\u200b", text)), style)


def _story(page: Page) -> list[Flowable]:
    lead = _style("lead", 8.5, colour=_SOFT, after=6)
    story = [*_head(page), *_remarks(page.remarks), _heading("Result"), _text(page.result_lead, lead), _results(page.rows)]
    story += [*_bullets("Why:", page.reasons), *_bullets("What to do next:", page.next_steps)]
    for table in page.tables:
        story += [_heading(table.title), _text(table.lead, lead), _table(table)]
    story += _pictures(page)
    solved = _facts([(row.label, row.after) for row in page.calibration_rows])
    story += [_heading("Calibration"), _text("What was solved, and from how much.", lead), solved]
    story += [_heading("Where this comes from"), _facts(page.identity), _text(_CLOSING + page.decision_rule, lead)]
    return story


_CLOSING = 'Lengths in mm. "U" is the expanded uncertainty, k = 2: about 95 of 100 such intervals hold the true value. '


def _head(page: Page) -> list[Flowable]:
    from reportlab.platypus import Spacer, TableStyle
    from reportlab.platypus import Table as Grid

    white = "#ffffff"
    cells = [
        [_text(page.title, _style("title", 9, colour=white))],
        [_text(page.headline, _style("headline", 20, colour=white, bold=True))],
        [_text(page.sentence, _style("sentence", 9.5, colour=white))],
    ]
    banner = Grid(cells, colWidths=[_WIDTH_PT])
    banner.setStyle(TableStyle([("BACKGROUND", (0, 0), (-1, -1), _TONES.get(page.tone, _SOFT)), ("LEFTPADDING", (0, 0), (-1, -1), 12)]))
    return [banner, Spacer(1, 8)]


def _remarks(remarks: Sequence[str]) -> list[Flowable]:
    from reportlab.platypus import Spacer, TableStyle
    from reportlab.platypus import Table as Grid

    found: list[Flowable] = []
    for remark in remarks:
        box = Grid([[_text(remark, _style("remark", 8.5))]], colWidths=[_WIDTH_PT])
        box.setStyle(TableStyle([("BACKGROUND", (0, 0), (-1, -1), "#fffbeb"), ("LINEBEFORE", (0, 0), (0, -1), 3, _TONES["unsure"])]))
        found += [box, Spacer(1, 4)]
    return found


def _heading(text: str) -> Flowable:
    style = _style("heading", 12.5, bold=True, after=4)
    style.spaceBefore, style.keepWithNext = 14, 1
    return _text(text, style)


def _bullets(title: str, lines: Sequence[str]) -> list[Flowable]:
    body = _style("bullet", 9, after=2)
    body.leftIndent, body.bulletIndent = 10, 2
    from reportlab.platypus import Paragraph

    return [_text(title, _style("why", 9, bold=True))] * bool(lines) + [Paragraph(escape(line), body, bulletText="•") for line in lines]


def _grid(cells: list[list[Flowable]], widths: Sequence[float], *, head: bool) -> Flowable:
    from reportlab.platypus import Table as Grid
    from reportlab.platypus import TableStyle

    grid = Grid(cells, colWidths=list(widths), repeatRows=1 if head else 0, hAlign="LEFT")
    lines = [("LINEBELOW", (0, 0), (-1, -1), 0.5, _LINE), ("VALIGN", (0, 0), (-1, -1), "TOP")]
    lines += [("LEFTPADDING", (0, 0), (0, -1), 0), ("LEFTPADDING", (1, 0), (-1, -1), 3), ("RIGHTPADDING", (0, 0), (-1, -1), 3)]
    grid.setStyle(TableStyle([*lines, ("TOPPADDING", (0, 0), (-1, -1), 2), ("BOTTOMPADDING", (0, 0), (-1, -1), 2)]))
    return grid


def _results(rows: Sequence[Row]) -> Flowable:
    head, words, helps = _style("head", 7.5, colour=_SOFT, bold=True), _style("word", 8.5, after=0), _style("help", 7, colour=_SOFT)
    number = _style("number", 8.5, right=True)
    cells: list[list[Any]] = [
        [_text(t, head if i in (0, 4) else _style("headr", 7.5, colour=_SOFT, bold=True, right=True)) for i, t in enumerate(_RESULT_HEADS)]
    ]
    for row in rows:
        marked = _style("mark", 8, colour=_TONES.get(row.tone, _SOFT), bold=True)
        before, after = (_style("figure", 8.5, colour=colour, right=True, bold=bold) for colour, bold in ((_BEFORE, False), (_AFTER, True)))
        figures = [_text(row.before, before), _text(row.after, after), _text(row.limit, number), _text(row.mark, marked)]
        cells.append([[_text(row.label, words), _text(row.help, helps)], *figures])
    return _grid(cells, [share * _WIDTH_PT for share in (0.44, 0.15, 0.14, 0.13, 0.14)], head=True)


_RESULT_HEADS = ("figure", "uncalibrated", "calibrated", "limit", "")


def _table(table: Table) -> Flowable:
    if not table.rows:
        return _text("none", _style("none", 8.5, colour=_SOFT))
    right = [table.numeric and i > 0 for i in range(len(table.heads))]
    size = 8.5 if len(table.heads) <= 6 else 7.0 if len(table.heads) <= 10 else 5.8
    heads = [_text(t, _style("head", size - 0.8, colour=_SOFT, bold=True, right=r)) for t, r in zip(table.heads, right, strict=True)]
    cells = [[_text(t, _style("cell", size, after=0, right=r)) for t, r in zip(row, right, strict=True)] for row in table.rows]
    # columns as wide as what they hold, within reason: words wrap, figures do not
    weight = [min(max(len(row[i]) for row in (table.heads, *table.rows)), 60) + 3 for i in range(len(table.heads))]
    return _grid([heads, *cells], [_WIDTH_PT * w / sum(weight) for w in weight], head=True)


def _facts(rows: Sequence[tuple[str, str]]) -> Flowable:
    name, value = _style("name", 8, colour=_SOFT, after=0), _style("value", 8, after=0)
    return _grid([[_text(a, name), _text(b, value)] for a, b in rows], [0.36 * _WIDTH_PT, 0.64 * _WIDTH_PT], head=False)


def _pictures(page: Page) -> list[Flowable]:
    from reportlab.platypus import Image, KeepTogether, Spacer

    found: list[Flowable] = []
    for picture in page.pictures:
        width, height = picture.svg.size_inch
        wanted = _WIDTH_PT if picture.wide else min(_WIDTH_PT, 1.5 * _SMALL_WIDTH_PT)
        image = Image(io.BytesIO(png_of(picture.svg)), width=wanted, height=wanted * height / width, hAlign="LEFT")
        words = [_text(picture.title, _style("picture", 9.5, bold=True)), _text(picture.caption, _style("caption", 8, colour=_SOFT))]
        found.append(KeepTogether([*words, image, Spacer(1, 8)]))
    return [_heading("Pictures"), *found] if found else []
