"""What a file is by its first bytes, whatever its name ends in.

Rule: nothing is parsed or executed; a signature is one that the format's own specification, or libmagic's list, gives.
A format that nothing of Trilane reads has a way to one that it reads.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

HEAD_BYTES = 512
PICTURE, VIDEO, ARRAY, PICKLE, ARCHIVE, FOREIGN = "picture", "video", "array", "pickle", "archive", "foreign"

_AS_BVH = "in Blender: File > Import, choose the armature, then File > Export > Motion Capture (.bvh)"
_OTHER_3D = f"export the motion as BVH, such as {_AS_BVH}"
_UNPACK = "unpack it and give the file inside"
_ARRAYS = "save its arrays with NumPy: np.savez(FILE, poses=..., trans=..., mocap_frame_rate=...)"


@dataclass(frozen=True)
class Signature:
    """`name`: with its article. `group`: one of the words above. `remedy`: how it is made usable."""

    name: str
    group: str = FOREIGN
    remedy: str = ""


#: The first that matches the head of a file counts.
SIGNATURES: tuple[tuple[bytes, Signature], ...] = (
    (rb"Kaydara FBX Binary|; FBX ", Signature("an FBX file", remedy=_OTHER_3D)),
    (rb"glTF", Signature("a binary glTF file (GLB, VRM)", remedy=_OTHER_3D)),
    (rb'\s*\{\s*"asset"\s*:\s*\{', Signature("a glTF file", remedy=_OTHER_3D)),
    (rb"PXR-USDC|#usda|PK\x03\x04.{26}[^\0]{0,120}\.usd", Signature("a USD file", remedy=_OTHER_3D)),
    (rb"BLENDER", Signature("a Blender file", remedy="in Blender: File > Export > Motion Capture (.bvh)")),
    (rb"Ogawa", Signature("an Alembic file", remedy=_OTHER_3D)),
    (rb"//Maya ASCII|FOR[48]....Maya", Signature("a Maya scene", remedy=_OTHER_3D)),
    (rb"Vocaloid Motion Data", Signature("a VMD file of MikuMikuDance", remedy=_OTHER_3D)),
    (rb"%YAML.{0,60}unity3d", Signature("a Unity asset", remedy="export the clip as FBX, then " + _AS_BVH)),
    (rb"\s*(<\?xml.{0,100})?<mvnx", Signature("an MVNX file", remedy="in Xsens MVN: File > Export > BVH")),
    (rb"(#[^\n]*\n|\s)*:(FULLY-SPECIFIED|version 1\.)", Signature("an ASF or AMC file", remedy=_OTHER_3D)),
    (rb"\s*<\?xml.{0,300}<COLLADA", Signature("a COLLADA file", remedy=_OTHER_3D)),
    (rb"[\x02-\x08]\x50", Signature("a C3D file", remedy="solve it to a skeleton and save that as BVH")),
    (rb"\x80[\x02-\x05]", Signature("a Python pickle", PICKLE, _ARRAYS)),
    (rb"\x89HDF\r\n\x1a\n", Signature("an HDF5 file", remedy=_ARRAYS)),
    (rb"MATLAB 5\.0 MAT-file", Signature("a MATLAB file", remedy=_ARRAYS)),
    (rb"version https://git-lfs", Signature("a Git LFS pointer, not the file itself", remedy="fetch it: git lfs pull")),
    (rb"(?i:\s*<(!doctype html|html))", Signature("a web page", remedy="download the file itself")),
    (rb"%PDF", Signature("a PDF file")),
    (rb"\x7fELF", Signature("a program")),
    (rb"ply\r?\n", Signature("a PLY model", remedy="it has no motion and no camera")),
    (rb"\xff\xfe|\xfe\xff", Signature("text in UTF-16", remedy="save it as UTF-8")),
    (rb"\x93NUMPY", Signature("a NumPy array (.npy)", ARRAY)),
    (rb"PK\x03\x04.{26}[^\0/]{0,120}/data\.pkl|PK\x03\x04.{26}[^\0/]{0,120}/\.format_version",
     Signature("a file of torch.save", remedy=_ARRAYS)),
    (rb"PK\x03\x04.{26}[^\0/]{0,120}\.npy", Signature("NumPy arrays (.npz)", ARRAY)),
    (rb"PK(\x03\x04|\x05\x06)", Signature("a ZIP archive", ARCHIVE, _UNPACK)),
    (rb"\x1f\x8b|BZh[1-9]1AY|\xfd7zXZ\0|7z\xbc\xaf|Rar!\x1a|\x28\xb5\x2f\xfd|.{257}ustar",
     Signature("a packed file", ARCHIVE, _UNPACK)),
    (rb"\x89PNG\r\n\x1a\n", Signature("a PNG picture", PICTURE)),
    (rb"\xff\xd8\xff", Signature("a JPEG picture", PICTURE)),
    (rb"GIF8[79]a", Signature("a GIF picture", PICTURE)),
    (rb"BM.{4}\0\0\0\0", Signature("a BMP picture", PICTURE)),
    (rb"RIFF.{4}WEBP", Signature("a WebP picture", PICTURE)),
    (rb"II\*\0|MM\0\*", Signature("a TIFF picture", PICTURE)),
    (rb"\0.{3}ftyp(hei|mif1|avif)", Signature("a HEIF picture", PICTURE, "save it as JPEG or PNG")),
    (rb"v/1\x01|#\?RADIANCE", Signature("an HDR picture", PICTURE, "save it as JPEG or PNG")),
    (rb"\0.{3}(ftyp|moov|mdat|wide|free)", Signature("an MP4 or QuickTime video", VIDEO)),
    (rb"\x1aE\xdf\xa3", Signature("a Matroska or WebM video", VIDEO)),
    (rb"RIFF.{4}AVI ", Signature("an AVI video", VIDEO)),
)  # fmt: skip
_PATTERNS = tuple((re.compile(pattern, re.DOTALL), signature) for pattern, signature in SIGNATURES)


def signature_of(path: Path) -> Signature | None:
    """What the regular file `path` is; None when its head says nothing. Raises OSError when it cannot be read."""
    with path.open("rb") as file:
        head = file.read(HEAD_BYTES)
    return signature_of_head(head)


def signature_of_head(head: bytes) -> Signature | None:
    """What a file is that begins with `head`, which is up to HEAD_BYTES long."""
    return next((signature for pattern, signature in _PATTERNS if pattern.match(head)), None)
