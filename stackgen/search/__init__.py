"""The best stacks for any silhouette, by search instead of learning."""
