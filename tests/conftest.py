"""Shared set-up of all tests: the hypothesis profiles.

`fast` (the default) is derandomized, so that a run on a busy machine tests the same cases as any other run and no
deadline depends on the clock. `deep` draws new cases and many more of them: `HYPOTHESIS_PROFILE=deep make test`.
"""

import os

from hypothesis import HealthCheck, settings

settings.register_profile(
    "fast", derandomize=True, deadline=None, max_examples=60, suppress_health_check=[HealthCheck.too_slow]
)
settings.register_profile("deep", deadline=None, max_examples=2000, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "fast"))
