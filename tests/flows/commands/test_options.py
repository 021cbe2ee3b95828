"""Options that stand for settings."""

from flows.commands.options import shortcut_settings


def test_options_that_are_not_given_change_nothing() -> None:
    assert shortcut_settings(None, None, None) == {}


def test_options_set_the_settings_that_their_help_names() -> None:
    assert shortcut_settings(8000, 512, 24.0, box="1,2,3,4", height_m=0.3, ground=False, compress=True) == {
        "mesh.max_faces": 8000,
        "mesh.texture_size": 512,
        "pack.fps": 24.0,
        "subject.box": (1, 2, 3, 4),
        "pack.height_m": 0.3,
        "pack.ground": False,
        "pack.gltf.meshopt": True,
    }
