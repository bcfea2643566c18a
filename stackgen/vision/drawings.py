"""From any picture of a structure to the silhouette that the models know.

The structure is whatever differs from the background, and the background is what lies along the
picture's edge. So polarity, colours and paper do not matter, and nothing has to be declared.
"""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stackgen.errors import StackgenError
from stackgen.vision.masks import bounding_box, components
from stackgen.world import Grid, Mask

if TYPE_CHECKING:
    from PIL.Image import Image

Levels = NDArray[np.float32]
Picture = NDArray[np.uint8]

_WORK_SIZE = 768  # longer edge [pixel] every picture is brought to, so that edges are found to a fraction of a pixel
_SMALLEST = 8  # [pixel], of the picture and of the structure in it
_SPECK = 0.005  # parts, and holes, under this share of the largest part are dirt
_CONTRAST = 20.0  # the least difference from the background that counts [of 255]
_EDGE_BAND = 0.02  # width of the strip along the edge that shows the background [of the shorter edge]


def read_silhouette(source: str | Path | ArrayLike, grid: Grid, exact: bool | None = None) -> Mask:
    """Read the front silhouette (H, W) from a picture, scaled and placed as the grid wants it.

    The structure is scaled, its proportions kept, until it is as high as the grid, or as wide where
    it would become wider than the grid; it is set on the ground line and centred. A pixel is set when
    at least half of it is covered.

    A picture that already is a silhouette of this grid is taken as it is: `image_size` pixels square,
    two values only, its structure's lowest row on the ground line, nothing on the picture's edge, and
    as high or as wide as the grid to within half a cell.

    Args:
        source: An image file, or an array: (H, W) bool with True where the structure is, or grey
            (H, W), or uint8 colour (H, W, 3) or (H, W, 4).
        grid: Scale and place of the result.
        exact: True takes the picture as it is (its size and two values suffice then), False always
            scales it, None decides by the rule above.

    Raises:
        StackgenError: If the picture cannot be read, is empty, or is filled to its edges.

    >>> tower = np.zeros((100, 80), bool)
    >>> tower[20:60, 10:20] = True  # four times as high as wide
    >>> placed = read_silhouette(tower, Grid())
    >>> placed.shape, int(placed.sum()), int(placed[59].sum())
    ((64, 64), 784, 14)
    """
    is_file = isinstance(source, str | Path)
    try:
        difference, scale = _difference(source)
        plain = difference.shape == (grid.image_size,) * 2 and len(np.unique(difference)) == 2
        if exact and not plain:
            raise StackgenError(
                f"to be taken as it is a picture must be {grid.image_size} x {grid.image_size} pixels of two values;"
                " leave exact out to have it scaled"
            )
        if plain and exact is not False and (exact or _fits(difference > 0, grid)):
            return difference > 0
        return _place(_structure(difference, scale), grid)
    except StackgenError as error:
        raise StackgenError(f"{source if is_file else 'the picture'}: {error}") from error


def read_picture(path: str | Path) -> Picture:
    """Read a colour picture (H, W, 3), upright.

    Raises:
        StackgenError: If the file is no picture.
    """
    try:
        return np.array(_open(Path(path)).convert("RGB"))
    except StackgenError as error:
        raise StackgenError(f"{path}: {error}") from error


def _difference(source: str | Path | ArrayLike) -> tuple[Levels, float]:
    """Return how much each pixel (H, W) differs from the background [0..255], and the scale of the reduced picture."""
    if isinstance(source, str | Path):
        picture = _open(Path(source))
    else:
        array = np.asarray(source)
        if array.ndim == 2 and array.dtype == bool:
            if min(array.shape) < _SMALLEST:
                raise _too_small("it", array.shape[1], array.shape[0])
            if array.all() or not array.any():
                raise StackgenError(f"{'everything' if array.any() else 'nothing'} is set; draw a structure")
            return array.astype(np.float32) * 255, 1.0
        picture = _from_array(array)
    if min(picture.size) < _SMALLEST:
        raise _too_small("it", *picture.size)
    if picture.mode not in ("L", "RGB") or "transparency" in picture.info:
        picture = picture.convert("RGBA")  # the numbers of a palette cannot be averaged
    factor = -(-max(picture.size) // _WORK_SIZE)
    colours, alpha = _channels(picture.reduce(factor) if factor > 1 else picture)
    # Where part of a picture is transparent, that part or the rest is the structure: colour says no more.
    levels = alpha if 0.05 < (alpha < 128).mean() < 0.999 else colours
    return _unlike_background(levels), 1.0 / factor


def _open(path: Path) -> Image:
    """Open the first frame of an image file, upright; 16-bit and float grey become 8-bit."""
    from PIL import Image, ImageOps, UnidentifiedImageError

    try:
        if path.is_dir():
            raise StackgenError("is a folder; give an image file")
        if path.stat().st_size == 0:
            raise StackgenError("is an empty file; give a PNG or JPEG image")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(path) as image:
                image.load()
                upright = ImageOps.exif_transpose(image)
        return _from_array(np.asarray(upright)) if upright.mode in ("I", "F") or ";" in upright.mode else upright
    except FileNotFoundError:
        raise StackgenError("no such file") from None
    except UnidentifiedImageError:
        raise StackgenError("is not an image that can be read; give a PNG or JPEG file") from None
    except Image.DecompressionBombError:
        raise StackgenError("has too many pixels; scale it down first") from None
    except (OSError, ValueError, SyntaxError, EOFError, MemoryError) as error:
        reason = getattr(error, "strerror", None) or str(error).splitlines()[:1] or ["damaged"]
        reason = reason if isinstance(reason, str) else reason[0]
        raise StackgenError(f"cannot be read ({reason}); the file may be cut short, save it again") from None


def _from_array(array: NDArray[Any]) -> Image:
    """Convert an array of grey (H, W) or uint8 colour (H, W, 3 or 4) to an image."""
    from PIL import Image

    is_grey = array.ndim == 2 and array.max(initial=0) > 1  # 0 and 1 alone are a mask, and stretched below
    is_colour = array.ndim == 3 and array.shape[2] in (3, 4) and array.size > 0
    if array.dtype == np.uint8 and (is_grey or is_colour):
        return Image.fromarray(array)
    if array.ndim != 2 or array.dtype.kind not in "biuf" or not array.size:
        raise StackgenError(
            f"an array must be (H, W) grey or bool, or (H, W, 3 or 4) uint8, got {array.dtype} {array.shape}"
        )
    values = array.astype(np.float64)
    if not np.isfinite(values).all():
        raise StackgenError("holds values that are not finite; replace them by 0")
    low, spread = values.min(), np.ptp(values)
    return Image.fromarray(np.round((values - low) * (255 / spread if spread else 0)).astype(np.uint8))


def _channels(picture: Image) -> tuple[Levels, Levels]:
    """Split into colour on white (H, W, 3) and opacity (H, W, 1), both 0..255."""
    rgba = np.asarray(picture.convert("RGBA"), dtype=np.float32)
    alpha = rgba[..., 3:]
    return (rgba[..., :3] * (alpha / 255) + (255 - alpha)).astype(np.float32), alpha


def _unlike_background(levels: Levels) -> Levels:
    """Return the largest difference (H, W) of any channel of `levels` (H, W, C) from the background's.

    The background is the median along the picture's upper, left and right edges: structures often
    stand on the lower one. Taking the largest channel makes colours of equal brightness differ, and
    stays linear over a blurred edge, so that half of it is the edge's middle.
    """
    band = max(1, round(min(levels.shape[:2]) * _EDGE_BAND))
    edges = (levels[:band], levels[:, :band], levels[:, -band:])
    border = np.concatenate([edge.reshape(-1, levels.shape[2]) for edge in edges])
    return np.abs(levels - np.median(border, axis=0)).max(axis=2)


def _structure(difference: Levels, scale: float) -> Mask:
    """Cut the structure's pixels out to their bounding box, at 768 pixels for the picture's longer edge."""
    import cv2

    enlarge = max(1.0, _WORK_SIZE / max(difference.shape))
    if enlarge > 1:
        height, width = (round(n * enlarge) for n in difference.shape)
        difference = np.asarray(cv2.resize(difference, (width, height), interpolation=cv2.INTER_LINEAR), np.float32)
    if np.quantile(difference, 0.999) < _CONTRAST:
        raise StackgenError("is all one colour, so nothing or everything is in it; draw a structure on a background")
    mask = _clean(difference > _threshold(difference))
    if mask.mean() > 0.98:
        raise StackgenError("the structure fills the whole frame; leave some background around it")
    if not mask.any():
        raise StackgenError("nothing but specks is in it; draw a structure on a background")
    cut = mask[bounding_box(mask)]
    if max(cut.shape) < _SMALLEST * enlarge * scale:
        raise _too_small("the structure in it", *(round(n / (enlarge * scale)) for n in cut.shape[::-1]))
    return cut


def _too_small(what: str, width: int, height: int) -> StackgenError:
    return StackgenError(
        f"{what} is only {width} x {height} pixels; at least {_SMALLEST} are needed, draw or scan it larger"
    )


def _threshold(difference: Levels) -> float:
    """Find the level where the structure begins: Otsu's, lowered while a paler part of the structure lies under it.

    A white house with a dark roof on grey has two steps. A paler part is told from a blurred edge by
    its thickness, and from uneven lighting by a clear step and by not reaching the picture's edge.
    """
    import cv2

    threshold = _otsu(difference)
    thick = np.ones((2 * (max(difference.shape) // 60) + 1,) * 2, np.uint8)
    for _ in range(3):
        below = difference[difference <= threshold]
        lower = _otsu(below) if len(below) else 0.0
        paler = (difference > lower) & (difference <= threshold)
        in_between = np.abs(difference - lower) < 0.25 * lower
        count, labels = cv2.connectedComponents(cv2.erode(paler.view(np.uint8), thick), connectivity=4)
        at_edge = np.unique(np.concatenate([labels[0], labels[:, 0], labels[:, -1]]))
        inside = np.isin(labels, at_edge, invert=True)
        enough = max(2 * _SPECK * np.count_nonzero(difference > threshold), 1)
        if lower < _CONTRAST / 2 or count < 2 or np.count_nonzero(inside) < enough:
            return threshold
        if np.count_nonzero(in_between) > 0.3 * np.count_nonzero(paler):
            return threshold
        threshold = lower
    return threshold


def _otsu(values: Levels) -> float:
    """Return the middle between the means of two groups of values [0..255], split by Otsu's method (1979)."""
    import cv2

    levels = np.clip(values, 0, 255).astype(np.uint8).ravel()
    split, _ = cv2.threshold(levels, 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
    is_low = levels <= split
    return float((levels[is_low].mean() + levels[~is_low].mean()) / 2) if 0 < is_low.sum() < is_low.size else 0.0


def _clean(mask: Mask) -> Mask:
    """Remove parts and fill holes that are tiny beside the mask's largest part."""
    labels, areas = components(mask, connectivity=4)
    limit = _SPECK * areas.max()
    kept = (areas >= max(limit, 1))[labels]
    holes, sizes = components(~kept, connectivity=4)
    return np.asarray(kept | (sizes < limit)[holes])


def _fits(mask: Mask, grid: Grid) -> bool:
    """Tell whether a mask (image_size square) is placed and scaled as the grid's silhouettes are."""
    rows, columns = bounding_box(mask)
    inside = rows.start > 0 and columns.start > 0 and columns.stop < grid.image_size
    on_ground = rows.stop == round(grid.image_size - grid.ground_margin)
    half = grid.pixels_per_cell / 2
    height, width = rows.stop - rows.start, columns.stop - columns.start
    fills = abs(height - grid.height * 2 * half) <= half or abs(width - grid.width * 2 * half) <= half
    return inside and on_ground and fills


def _place(cut: Mask, grid: Grid) -> Mask:
    """Scale a structure that is cut out to its box until it fills the grid, on the ground and centred.

    OpenCV's INTER_AREA scales to whole pixels only, which moves edges: 3 of the 12 examples would change.
    """
    height, width = cut.shape
    scale = grid.pixels_per_cell * min(grid.height / height, grid.width / width)  # [target pixel per pixel]
    columns = (np.arange(grid.image_size + 1) - grid.image_size / 2) / scale + width / 2
    rows = (np.arange(grid.image_size + 1) - (grid.image_size - grid.ground_margin)) / scale + height
    covered = _overlap(rows, height) @ cut.astype(np.float64) @ _overlap(columns, width).T
    placed = covered >= 0.5 - 1e-9
    if not placed.any():
        raise StackgenError("the structure is too thin to be seen at the grid's scale; draw it bolder")
    return placed


def _overlap(edges: NDArray[np.float64], length: int) -> NDArray[np.float64]:
    """Return the share (n, length) of each interval between `edges` (n + 1) that each of `length` unit cells covers."""
    low, high = edges[:-1, None], edges[1:, None]
    cells = np.arange(length)
    return np.clip(np.minimum(high, cells + 1) - np.maximum(low, cells), 0, None) / (high - low)


def grid_offset(silhouette: Mask, grid: Grid) -> int:
    """Find by how many pixels to shift a silhouette so that its upright edges fall on the grid's cell lines.

    Stacks of the generator stand on the cells of the grid, so samplers trained on them know edges there
    and nowhere else; a drawing is centred, which puts a structure of odd width half a cell beside. The
    shift is at most half a cell; the smallest of equally good ones is taken.

    >>> picture = np.zeros((64, 64), dtype=bool)
    >>> picture[4:60, 25:39] = True  # a tower, one cell wide, in the middle
    >>> abs(grid_offset(picture, Grid()))
    7
    """
    steps = np.diff(silhouette.astype(np.int8), axis=1, prepend=0, append=0)
    edges = np.abs(steps).sum(axis=0)  # number of rows with an edge left of each column
    places = np.arange(len(edges)) - grid.image_size / 2 - grid.cell_edge * grid.pixels_per_cell
    filled = np.flatnonzero(silhouette.any(axis=0))
    half = round(grid.pixels_per_cell / 2)
    best, best_score = 0, -np.inf
    for offset in sorted(range(-half, half + 1), key=abs):
        if filled.size and not (0 <= filled[0] + offset and filled[-1] + offset < grid.image_size):
            continue
        phase = (places + offset) / grid.pixels_per_cell
        distance = np.abs(phase - np.round(phase)) * grid.pixels_per_cell  # [pixel] to the next cell line
        score = float((edges * np.maximum(0, 2 - distance)).sum())
        if score > best_score + 1e-9:
            best, best_score = offset, score
    return best
