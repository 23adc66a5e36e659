"""Clean, world-space human pose for robots and kiosks, live, from any noisy 3D skeleton source.

In the repository the rooms `msgs`, `prior`, `nodes`, `launch` and `benchmarks` stand at the top; they are installed in
here, so that nobody's own package of such a name is shadowed.
"""

from pathlib import Path

PACKAGE = Path(__file__).parent
"""Where this package lies, with launch files, weights and a sample stream inside."""
