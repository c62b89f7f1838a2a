"""What passes between the page and its server. Rule: a kind, then a payload; what clients say is checked.

Kind 1 is JSON in UTF-8, both ways. Kind 2, to the page alone, is a picture: the frame's number (uint32), its time in
the scene and its age (float64, ms), all little-endian, then a JPEG. What a client may say stands in one table.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from typing import Annotated, Any, Final, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

JSON_KIND: Final = 1
PICTURE_KIND: Final = 2
MOST_BYTES: Final = 4096
LONGEST_VALUE: Final = 512
LONGEST_SPAN_MS: Final = 3_600_000.0

_PICTURE = struct.Struct("<BIdd")
Finite = Annotated[float, Field(allow_inf_nan=False)]


class Said(BaseModel):
    """Something that a client says: every key is known and has its type."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class PictureAsked(Said):
    """The newest picture is wanted that this client has not had."""

    type: Literal["picture"]


class ControlSaid(Said):
    """The control `name` is to have `value`; whether it can is the control's to say."""

    type: Literal["control"]
    name: str = Field(max_length=40)
    value: (
        Annotated[str, Field(max_length=LONGEST_VALUE)]
        | Finite
        | Annotated[list[Finite], Field(min_length=2, max_length=2)]
        | None
    ) = None


class Seek(Said):
    """Of a finished run, what was `span_ms` before and after `t_ms` is wanted."""

    type: Literal["seek"]
    t_ms: Finite = Field(ge=0)
    span_ms: Finite = Field(gt=0, le=LONGEST_SPAN_MS)


_MESSAGES: TypeAdapter[Any] = TypeAdapter(Annotated[PictureAsked | ControlSaid | Seek, Field(discriminator="type")])


class MalformedError(ValueError):
    """Bytes that are nothing that a client may say."""


def heard(data: bytes) -> PictureAsked | ControlSaid | Seek:
    """What a client said with `data`. Raises MalformedError."""
    if data[:1] != bytes([JSON_KIND]):
        raise MalformedError("a kind that no client sends")
    try:
        message: PictureAsked | ControlSaid | Seek = _MESSAGES.validate_json(data[1:])
    except ValidationError as error:
        raise MalformedError(error.errors()[0]["msg"]) from None
    return message


def said(message: Mapping[str, Any]) -> bytes:
    """`message` for the page. Raises ValueError for a NaN or an infinity."""
    text = json.dumps(message, separators=(",", ":"), allow_nan=False)
    return bytes([JSON_KIND]) + text.encode()


def shown(frame: int, media_ms: float, age_ms: float, jpeg: bytes) -> bytes:
    """A picture for the page."""
    return _PICTURE.pack(PICTURE_KIND, frame & 0xFFFFFFFF, media_ms, age_ms) + jpeg
