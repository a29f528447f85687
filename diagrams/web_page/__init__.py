"""Diagrams as pages that run: WebAssembly, plots that scroll, sliders."""

from .page_html import PageText, Scene
from .web_page import WebPage, make_page

__all__ = ["PageText", "Scene", "WebPage", "make_page"]
