"""Reading of XML files: hands (URDF, xacro, MJCF) and meshes (.dae)."""

from __future__ import annotations

import codecs
from typing import Any, NoReturn
from xml.etree.ElementTree import Element, TreeBuilder, XMLParser


class _Builder(TreeBuilder):
    """Builder that rejects a DOCTYPE, whose entities can expand to gigabytes."""

    def doctype(self, *_: Any) -> NoReturn:
        raise ValueError("it holds a DOCTYPE; leave it out")


def read_xml(blob: bytes) -> Element:
    """Return the root element of an XML file, whose declaration may follow comments."""
    if blob.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        blob = blob.decode("utf-16").encode()
    try:
        blob.decode()
        encoding = "utf-8"
    except UnicodeDecodeError:  # only names and comments have such letters
        encoding = "iso-8859-1"
    parser = XMLParser(target=_Builder(), encoding=encoding)
    if blob.lstrip().startswith((b"<?xml", b"<!--")):
        blob = blob[max(0, blob.find(b"<?xml")) :]
    parser.feed(blob)
    return parser.close()
