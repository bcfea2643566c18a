"""A metric of your own: how often at least one of a scene's samples stands and matches."""

from stackgen.evaluation.metrics import SCENE_METRICS, SceneScore
from stackgen.training import SampleQuality


def best_of_all(scene: SceneScore) -> tuple[float, float]:
    """Give (sum, weight) of one scene's scores; over scenes the metric is the sum over the weight."""
    return float(any(sample.valid for sample in scene.samples)), 1


SCENE_METRICS["best_of_all"] = best_of_all  # in logs, and in `metrics.json` with its interval


class Quality(SampleQuality):
    """Named in a configuration, this file is loaded, and `sample/best_of_all` is logged."""
