"""Modules that the app's processes begin with: imported once, in the process that they are forks of
(``dem_jax.app.launch``). None of them starts a thread or a device of JAX, which no fork would have.
"""

import warnings

import jax  # noqa: F401

import dem_jax.app.facts
import dem_jax.cli.main
import dem_jax.cli.worker
import dem_jax.runner.interface
import dem_jax.study.outputs
import dem_jax.visualization.summary
import dem_jax.visualization.web_viewer  # noqa: F401

warnings.filterwarnings("ignore", r"os\.fork\(\) was called", RuntimeWarning)  # of jax
