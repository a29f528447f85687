"""A report as a document: sections, tables and numbers, written as HTML, PDF and JSON."""
