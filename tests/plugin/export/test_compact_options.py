"""Messages of the export about the requested size."""

import pytest

from bitymi_ns.plugin.export import command
from bitymi_ns.plugin.export.command import CompactOptions


def test_a_bundle_much_smaller_than_was_asked_for_is_explained(monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []
    monkeypatch.setattr(command, "say", said.append)
    CompactOptions(target_mb=1.5).print_size(1_400_000)
    CompactOptions().print_size(1)
    assert not said
    CompactOptions(target_mb=1.5).print_size(520_000)
    assert "0.52 MB suffice, of the 1.5 MB" in said[0]
