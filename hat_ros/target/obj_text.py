"""The text of a Wavefront OBJ, made plain: absolute indices, no continued or indented lines, no lines or points.

``trimesh`` resolves relative (negative) indices against all vertices of the file; the format counts those that stand
above the face. It also overlooks indented lines, and joins continued ones without a space.
Format: http://paulbourke.net/dataformats/obj/
"""

from __future__ import annotations

import re

from hat_ros.errors import MeshError

_KINDS = (b"v", b"vt", b"vn")
_KEPT = (b"o", b"g", b"usemtl", b"mtllib")
# What trimesh does not read as the format means it: relative indices, indented or tabbed keywords, lone corners.
_UNUSUAL = re.compile(
    rb"^f[ \t][^\n]*[-#]|^[ \t]+\S|^(?:v|vt|vn|f|o|g|usemtl|mtllib)\t|^[lp][ \t]|^#[^\n]*mtllib", re.MULTILINE
)


def plain_obj(text: bytes, name: str) -> bytes:
    """The same faces as text that ``trimesh`` reads rightly; text that is plain already comes back as it is.

    Args:
        text: content of the file.
        name: of the file, for the error.

    Raises:
        MeshError: a face refers to a vertex that the file does not have.
    """
    text = text.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    if b"\\\n" in text:
        text = _joined(text)
    if not _UNUSUAL.search(text):
        return text
    counts = dict.fromkeys(_KINDS, 0)
    lines = []
    for number, line in enumerate(text.split(b"\n"), start=1):
        key, _, rest = line.strip().replace(b"\t", b" ").partition(b" ")
        if key in counts:
            counts[key] += 1
            lines.append(key + b" " + rest.strip())
        elif key == b"f":
            corners = rest.partition(b"#")[0].split()
            lines.append(b"f " + b" ".join(_absolute(corner, counts, f"{name}, line {number}") for corner in corners))
        elif key in _KEPT:
            lines.append(key + b" " + rest.strip())
    return b"\n".join(lines) + b"\n"


def material_libraries(text: bytes) -> list[str]:
    """The material files that a plain text names, in order; several may stand on one line."""
    names: list[str] = []
    for line in re.findall(rb"^mtllib[ \t]+(\S[^\n]*?)[ \t]*$", text, re.MULTILINE):
        whole = line.decode("utf-8", "replace")
        parts = re.findall(r"\S.*?\.mtl(?=\s|$)", whole, re.IGNORECASE)
        names += [name for name in (parts or [whole]) if name not in names]
    return names


def _joined(text: bytes) -> bytes:
    """Continued lines in one. A comment that ends in a backslash, as a Windows path does, is no such line."""
    lines: list[bytes] = []
    is_open = False
    for line in text.split(b"\n"):
        if is_open:
            lines[-1] += b" " + line
        else:
            lines.append(line)
        is_open = line.endswith(b"\\") and not lines[-1].lstrip().startswith(b"#")
        if is_open:
            lines[-1] = lines[-1][:-1]
    return b"\n".join(lines)


def _absolute(corner: bytes, counts: dict[bytes, int], where: str) -> bytes:
    """``vertex``, ``vertex/texture``, ``vertex//normal`` or all three, counted from the file's first on."""
    indices = corner.split(b"/")
    if len(indices) > 3:
        raise MeshError(f"CAD model {where}: a corner has at most three indices, found '{_shown(corner)}'")
    found = []
    for kind, index in zip(_KINDS, indices, strict=False):
        if index[:1] == b"-":
            if not index[1:].isdigit() or not 0 < int(index[1:]) <= counts[kind]:
                raise MeshError(
                    f"CAD model {where}: index {_shown(index)} of '{_shown(corner)}' reaches beyond the "
                    f"{counts[kind]} lines '{kind.decode()}' above it"
                )
            index = b"%d" % (counts[kind] + 1 + int(index))
        found.append(index)
    return b"/".join(found)


def _shown(text: bytes) -> str:
    return text[:40].decode("ascii", "replace")
