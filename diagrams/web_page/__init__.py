"""Diagrams as pages that run: WebAssembly, plots that scroll, sliders."""

from .web_page import PageText, Scene, WebPage, make_page

__all__ = ["PageText", "Scene", "WebPage", "make_page"]
