"""Which unknowns get a profile, and how many."""

from phongfit.fitting.uncertainty.diagnostics import choose_profiles

LABELS = ("ambient.red", "diffuse.red", "diffuse.green", "specular.red", "shininess")


def test_the_exponent_first_and_one_of_each_kind():
    chosen = choose_profiles(LABELS, LABELS)
    assert chosen == ("shininess", "specular.red", "diffuse.red")


def test_what_is_not_identified_gets_none():
    chosen = choose_profiles(LABELS[:3], LABELS)
    assert chosen == ("diffuse.red", "ambient.red")
    assert choose_profiles((), LABELS) == ()


def test_two_angles_of_one_direction_get_none():
    direction = "scene.lights[0].direction.x"
    assert choose_profiles((direction,), (direction, direction)) == ()
    assert choose_profiles(("shininess", direction), ("shininess",)) == ("shininess",)
