"""The best stacks for any silhouette, by search instead of learning."""

from stackgen.search.sampler import SearchBlockLists, SearchSampler

__all__ = ["SearchBlockLists", "SearchSampler"]
