"""Mixtures of Gaussians as models of color."""

import numpy as np
from scipy.stats import multivariate_normal

from dg4d_lib.video.color_models import MIN_VARIANCE, fit_mixture


def test_a_mixture_finds_its_clusters():
    random = np.random.default_rng(0)
    centers = np.array([(20, 0, 0), (50, 40, 0), (70, -30, 20), (90, 0, 60), (40, 0, -50)], float)
    colors = (centers[:, None] + random.normal(0, 2, (5, 300, 3))).reshape(-1, 3)
    means = fit_mixture(colors, np.ones(len(colors))).means
    gaps = np.linalg.norm(means[:, None] - centers, axis=2).min(0)
    assert gaps.max() < 1


def test_the_density_of_a_mixture_of_one_cluster_is_that_of_a_gaussian():
    colors = np.random.default_rng(1).multivariate_normal((40, 10, -5), [(30, 5, 0), (5, 20, 3), (0, 3, 9)], 4000)
    found = fit_mixture(colors, np.ones(len(colors))).log_density(colors)
    spread = np.cov(colors.T) + MIN_VARIANCE * np.eye(3)
    assert abs(found - multivariate_normal(colors.mean(0), spread).logpdf(colors)).mean() < 0.15
