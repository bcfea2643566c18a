"""Lightning under either of its names, so that training runs where only the older package is."""

try:
    import lightning.pytorch as pl
except ImportError:
    import pytorch_lightning as pl  # type: ignore[no-redef]

__all__ = ["pl"]
