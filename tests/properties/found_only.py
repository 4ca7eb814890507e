"""A plugin of pytest: a property that fails is found and not shrunk."""

from __future__ import annotations

from hypothesis import Phase, settings

from analogrig.testing import strategies

settings.register_profile("analogrig-ci", parent=strategies.profile("ci"), phases=[Phase.explicit, Phase.generate])
