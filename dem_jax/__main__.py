"""Command line: python -m dem_jax run | ensemble | scenes | plot | report | export | render | vtk."""

import sys

from dem_jax.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
