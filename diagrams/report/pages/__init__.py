"""A report as a document: sections, tables and numbers, written as HTML, PDF and JSON."""

from .definitions import DEFINITIONS, read_definitions
from .document import SUMMARY, Judged, Plot, Section, Table, TableForm, compare_columns
from .printed_values import plain, quantity
from .report import Report, check_files, write_report
from .svg import draw_section, keep_drawings
from .templating import Texts

__all__ = [
    "DEFINITIONS",
    "SUMMARY",
    "Judged",
    "Plot",
    "Report",
    "Section",
    "Table",
    "TableForm",
    "Texts",
    "check_files",
    "compare_columns",
    "draw_section",
    "keep_drawings",
    "plain",
    "quantity",
    "read_definitions",
    "write_report",
]
