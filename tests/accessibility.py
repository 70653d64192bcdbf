"""The rules of axe (https://github.com/dequelabs/axe-core) that an open page violates."""

from __future__ import annotations

from typing import Any


def violations(page: Any) -> list[str]:
    """Return each violated rule with the elements that violate it; ``page`` is one of playwright."""
    from axe_playwright_python.sync_playwright import Axe

    found = Axe().run(page).response["violations"]
    return [f"{rule['id']}: {', '.join(node['html'][:150] for node in rule['nodes'])}" for rule in found]
