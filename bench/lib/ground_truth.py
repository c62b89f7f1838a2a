"""Ground truth for the benches that need the error of a picture: the default body, clothed, drawn on the GPU.

Rule: it is drawn by what training draws its samples with.
"""

from __future__ import annotations

from typing import Any

from trilane.avatars.bundle import Bundle
from trilane.body.body import ShapedBody
from trilane.errors import MissingPartError


def ground_truth(bundle: Bundle) -> tuple[Any, Any]:
    """The renderer of the bundle's body, clothed, and the `image_error` of two pictures. Raises MissingPartError."""
    try:
        from trilane.training.clothing.looks import look_of
        from trilane.training.image_error import image_error
        from trilane.training.sample_renderer import SampleRenderer
    except ImportError as error:
        raise MissingPartError(f"ground truth needs {error.name}", extra="train") from None
    return SampleRenderer(shaped_body(bundle), look=look_of(bundle.manifest.provenance)), image_error


def shaped_body(bundle: Bundle) -> ShapedBody:
    """The body of `bundle` in the shape that its manifest says."""
    return bundle.shaped_body()
