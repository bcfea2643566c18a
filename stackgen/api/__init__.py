"""The library's front door."""

from stackgen.api.model import BlockList, Model, Silhouette, check, load, sample
from stackgen.api.pictures import best

__all__ = ["BlockList", "Model", "Silhouette", "best", "check", "load", "sample"]
