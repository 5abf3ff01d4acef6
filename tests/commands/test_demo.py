"""Source of truth: the settings that are parsed from a printed command."""

import shlex
from dataclasses import replace
from pathlib import Path

import pytest
import tyro

from hyperplanes.commands.demo import Arguments, settings_of
from hyperplanes.experiments.demonstration.settings import DemoSettings


@pytest.mark.parametrize(
    "settings",
    [
        DemoSettings(),
        DemoSettings(class_name="chair", objects=9, held_out=3, resolution=32, preset="small", steps=7, seed=2),
        DemoSettings.quick_check(),
        replace(DemoSettings.quick_check(3), class_name="lamp", meshes=Path("tests/my meshes")),
    ],
)
def test_the_printed_command_gives_the_same_settings(settings, tmp_path):
    settings = settings if settings.meshes is None else replace(settings, meshes=tmp_path)
    command = shlex.split(settings.command(Path("my runs/demo")))
    assert command[:2] == ["hyperplanes", "demo"]
    arguments = tyro.cli(Arguments, args=command[2:])
    assert arguments.out == Path("my runs/demo")
    assert settings_of(arguments) == settings
