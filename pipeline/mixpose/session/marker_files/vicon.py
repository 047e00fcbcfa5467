"""Vicon's .vsk: XML in which positions of markers name parameters, in mm.

A file may describe a skeleton of several segments; a rigid body has one.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET

import numpy as np

from mixpose.session.markers import Markers
from mixpose.session.messages import BadKeyError, found, under
from mixpose.session.text_files import as_text

_TARGET = "TargetLocalPointToWorldPoint"


def read_vsk(content: bytes) -> Markers:
    """Read the markers of a Vicon subject that is one rigid body.

    Raises BadKeyError if the file is no such XML, is a skeleton, or lacks a parameter.
    """
    text = as_text(content)
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise BadKeyError("found a DOCTYPE or ENTITY, which a .vsk file does not have")
    try:
        root = ET.fromstring(text)
    except ET.ParseError as error:
        raise BadKeyError(f"not XML: {error}") from error
    if root.tag != "KinematicModel":
        raise BadKeyError(found(f"<{root.tag}>", "<KinematicModel>, as a Vicon .vsk begins"))
    parameters = {each.get("NAME", ""): each.get("VALUE", "") for each in root.iter("Parameter")}
    targets = list(root.iter(_TARGET))
    segments = {target.get("SEGMENT") for target in targets}
    if len(segments) > 1:
        raise BadKeyError(
            f"found markers on {len(segments)} segments; allowed: a rigid body, which is one"
        )
    if not targets:
        raise BadKeyError(f"found no markers ({_TARGET}) in it")
    names = tuple(target.get("MARKER", f"{k + 1}") for k, target in enumerate(targets))
    points = []
    for target, name in zip(targets, names, strict=True):
        with under("marker", name):
            points.append(_position(target.get("POSITION", ""), parameters))
    return Markers(np.array(points), None, names)


def _position(text: str, parameters: dict[str, str]) -> list[float]:
    """Three numbers, or three names of parameters in quotes."""
    values = []
    for word in text.split():
        name = word.strip("'\"")
        if name != word and name not in parameters:
            raise BadKeyError(f'found no parameter "{name}"')
        try:
            values.append(float(parameters.get(name, name)))
        except ValueError as error:
            raise BadKeyError(found(parameters.get(name, name), "a number")) from error
    if len(values) != 3:
        raise BadKeyError(found(text, "POSITION with three coordinates"))
    return values
