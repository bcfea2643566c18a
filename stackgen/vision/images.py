"""What a file, an array or a PIL image holds: colours, opacity, or one channel of many levels.

Every picture is decoded here and by Pillow alone, so that every command says the same of a damaged file.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stackgen.errors import StackgenError
from stackgen.io.arrays import read_npy
from stackgen.io.files import read_bytes
from stackgen.world import Mask

if TYPE_CHECKING:
    from PIL.Image import Image

Picture = NDArray[np.uint8]

FORMATS = ("PNG", "JPEG", "WEBP", "TIFF", "GIF", "BMP")
"""Formats that are opened; others, PostScript above all, would start programs of their own."""

LARGEST = 1200
"""Pictures of twice this longer edge [pixel] and more are reduced when they are read, to no less than it."""

SMALLEST = 8
"""Least edge of a picture, and of the structure in it [pixel]."""

CONTRAST = 20.0
"""Least difference between the tones of a drawing that counts [of 255]."""

_LARGE = 400  # dots of a palette in larger pictures may be two pixels apart

_MOST_PIXELS = 90_000_000


@dataclass(frozen=True)
class Image8:
    """A picture of 8 bits, reduced to less than twice `LARGEST`.

    Args:
        colours: (H, W, 3), on white where it is transparent.
        alpha: (H, W) opacity, None where all is opaque.
        factor: Edge of one of its pixels in pixels of the original.
    """

    colours: Picture
    alpha: Picture | None = None
    factor: float = 1.0


@dataclass(frozen=True)
class Levels:
    """One channel (H, W) of more than 256 levels, as stored: a depth frame, or a picture of 16 bits."""

    values: NDArray[Any]


Raster = Image8 | Levels


def load(source: str | Path | ArrayLike | Image) -> Raster:
    """Read a picture or a frame.

    Args:
        source: An image file or a .npy; an array (H, W) of grey, (H, W, 3 or 4) of uint8 colours, or (H, W) bool with
            True where the structure is, which is read as black on white; or a PIL image.

    Raises:
        StackgenError: If it is no picture, damaged, too large or too small.
    """
    from PIL.Image import Image

    if isinstance(source, str | Path):
        path = Path(source)
        return Levels(_array_in(path)) if path.suffix.lower() == ".npy" else _of_image(_open(path))
    if isinstance(source, Image):
        return _of_image(_upright(source))
    return _of_array(np.asarray(source))


def name_of(source: object) -> str:
    """Return what an error calls a source."""
    return str(source) if isinstance(source, str | Path) else "the picture"


def too_small(what: str, width: float, height: float) -> StackgenError:
    """Say how small something is."""
    return StackgenError(
        f"{what} is only {width:.0f} x {height:.0f} pixels; at least {SMALLEST} are needed, draw or scan it larger"
    )


def _open(path: Path) -> Image:
    """Decode the first frame of an image file, upright; a JPEG at no more than the size that is needed."""
    from PIL import Image, UnidentifiedImageError

    _require_content(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(path, formats=FORMATS) as image:
                image.draft("RGB", (LARGEST, LARGEST))
                if image.width * image.height > _MOST_PIXELS:
                    raise StackgenError(
                        f"has {image.width} x {image.height} pixels, too many to be read; scale it down first"
                    )
                image.load()
                return _upright(image)
    except UnidentifiedImageError:
        raise StackgenError(
            "is not an image that can be read, or is damaged; give a PNG, JPEG, WebP, TIFF, GIF or BMP file"
        ) from None
    except Image.DecompressionBombError:
        raise StackgenError("has too many pixels to be read; scale it down first") from None
    except StackgenError:
        raise
    except Exception as error:  # noqa: BLE001 - decoders raise anything at damaged bytes
        reason = getattr(error, "strerror", None) or (str(error).splitlines() or ["its bytes are damaged"])[0]
        raise StackgenError(f"cannot be read ({reason}); the file is damaged or cut short, save it again") from None


def _require_content(path: Path) -> None:
    try:
        if path.is_dir():
            raise StackgenError("is a folder; give an image file")
        if path.stat().st_size == 0:
            raise StackgenError("is an empty file; give an image file")
        with path.open("rb"):
            pass
    except FileNotFoundError:
        raise StackgenError("no such file") from None
    except OSError as error:
        raise StackgenError(f"cannot be opened: {error.strerror or error}") from None


def _array_in(path: Path) -> NDArray[Any]:
    """Read a .npy of numbers (H, W)."""
    _require_content(path)
    try:
        values = read_npy(read_bytes(path))
    except (OSError, ValueError, MemoryError):
        raise StackgenError("cannot be read: it is no array of numbers, or is cut short") from None
    if values.ndim != 2 or values.dtype.kind not in "uif" or not values.size:
        raise StackgenError(f"a depth frame is an array (H, W) of numbers, got {values.dtype} {values.shape}")
    return values


def _upright(image: Image) -> Image:
    from PIL import ImageOps

    return ImageOps.exif_transpose(image)


def _of_image(image: Image) -> Raster:
    from PIL import ImageFilter

    if image.mode in ("I", "F") or ";" in image.mode:
        return Levels(np.asarray(image))
    if min(image.size) < SMALLEST:
        raise too_small("it", *image.size)
    dithered = image.mode == "P" and _is_dithered(np.asarray(image))
    if image.mode not in ("L", "RGB") or "transparency" in image.info:
        image = image.convert("RGBA")  # the numbers of a palette cannot be averaged
    if dithered:
        image = image.filter(ImageFilter.BoxBlur(2 if min(image.size) > _LARGE else 1))
    factor = max(1, max(image.size) // LARGEST)
    reduced = image.reduce(factor) if factor > 1 else image
    if reduced.mode != "RGBA":
        return Image8(np.array(reduced.convert("RGB")), None, factor)
    rgba = np.array(reduced)
    alpha = rgba[..., 3]
    if alpha.min() == 255:
        return Image8(rgba[..., :3], None, factor)
    share = alpha[..., None].astype(np.float32) / 255
    colours = np.round(rgba[..., :3] * share + 255 * (1 - share)).astype(np.uint8)
    return Image8(colours, alpha, factor)


def _is_dithered(numbers: NDArray[np.uint8]) -> bool:
    """Tell whether the colours of a palette (H, W) were mixed from dots rather than drawn in even patches."""
    return float(np.count_nonzero(numbers[:, 1:] != numbers[:, :-1])) > 0.1 * numbers.size


def _of_array(array: NDArray[Any]) -> Raster:
    from PIL import Image

    if array.ndim == 2 and array.dtype == bool:
        return _of_mask(array)
    if array.dtype == np.uint8 and array.ndim == 3 and array.shape[2] in (3, 4) and array.size:
        return _of_image(Image.fromarray(array))
    if array.ndim != 2 or array.dtype.kind not in "buif" or not array.size:
        raise StackgenError(
            f"an array must be (H, W) grey or bool, or (H, W, 3 or 4) uint8, got {array.dtype} {array.shape}"
        )
    if array.dtype == np.uint8 and array.max() > 1:  # 0 and 1 alone are a mask, and stretched
        return _of_image(Image.fromarray(array))
    return Levels(array)


def _of_mask(mask: Mask) -> Image8:
    if min(mask.shape) < SMALLEST:
        raise too_small("it", mask.shape[1], mask.shape[0])
    if mask.all() or not mask.any():
        raise StackgenError(f"{'everything' if mask.any() else 'nothing'} is set; draw a structure")
    raster = _of_image(_grey_image(np.where(mask, 0, 255).astype(np.uint8)))
    assert isinstance(raster, Image8)
    return raster


def as_picture(levels: Levels) -> Image8:
    """Stretch one channel of many levels to 8 bits.

    Raises:
        StackgenError: If a value is not finite.
    """
    values = levels.values.astype(np.float64)
    if not np.isfinite(values).all():
        raise StackgenError("holds values that are not finite; replace them by 0")
    raster = _of_image(_grey_image(as_bytes(values)))
    assert isinstance(raster, Image8)
    return raster


def _grey_image(values: NDArray[np.uint8]) -> Image:
    from PIL import Image

    return Image.fromarray(values)


def as_bytes(values: NDArray[Any]) -> NDArray[np.uint8]:
    """Stretch finite values (H, W) over 0..255."""
    low, spread = float(values.min()), float(np.ptp(values))
    return np.asarray(np.round((values.astype(np.float64) - low) * (255 / spread if spread else 0)), np.uint8)


def of_two_tones(values: NDArray[np.uint8]) -> bool:
    """Tell whether levels (H, W) lie near to two of them, far apart; the edges between both may be soft."""
    import cv2

    _, high = cv2.threshold(values, 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
    if high.min() == high.max():
        return True
    ends, off = [], []
    for tone in (cv2.bitwise_not(high), high):
        core = cv2.erode(tone, np.ones((3, 3), np.uint8))
        within = values[(core if core.any() else tone) > 0]
        ends.append(float(np.median(within)))
        off.append(float(np.abs(within - ends[-1]).mean()))
    apart = ends[1] - ends[0]
    beyond = (values < ends[0] - 0.35 * apart) | (values > ends[1] + 0.35 * apart)  # ink in a shadow is darker still
    return bool(apart > CONTRAST and max(off) < 0.065 * apart + 2 and beyond.mean() < 0.003)
