from __future__ import annotations

from hypothesis import settings

# The time of an example is no property of the code on a shared machine, and a failure must come back on the next run.
settings.register_profile("unbend", deadline=None, derandomize=True, max_examples=40)
settings.load_profile("unbend")
