import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from phongfit.testing import check_gradients


def test_agreement_is_silent():
    check_gradients(lambda x: jnp.sin(x[0]) * x[1] ** 3, (np.array(0.3), np.array(1.2)))


def test_works_in_double_whatever_the_setting():
    before = jax.config.jax_enable_x64  # pyright: ignore[reportAttributeAccessIssue]
    seen = []

    def square(x):
        seen.append(x.dtype)
        return x**2

    check_gradients(square, jnp.asarray([1.0, 2.0], jnp.float32))
    assert set(seen) == {np.dtype("float64")}
    assert jax.config.jax_enable_x64 == before  # pyright: ignore


def test_single_precision_that_is_closed_over():
    with jax.enable_x64(False):
        kept = jnp.zeros(2)

    def total(x):
        return jax.lax.scan(lambda sum, a: (sum + a * x, None), kept, jnp.ones(3))[0]

    with pytest.raises(ValueError, match="function: .* closes over in point"):
        check_gradients(total, np.array(1.5))
    with pytest.raises(TypeError, match="unsupported operand"):
        check_gradients(lambda x: x + "float", np.array(1.5))


@jax.custom_jvp
def wrong_slope(x):
    return x**2


@wrong_slope.defjvp
def _(primals, tangents):
    (x,), (tangent,) = primals, tangents
    return x**2, 3 * x * tangent


@jax.custom_vjp
def wrong_reverse(x):
    return jnp.sum(x**2)


wrong_reverse.defvjp(lambda x: (wrong_reverse(x), x), lambda x, up: (2.1 * x * up,))


@jax.custom_jvp
def slope(x):
    return 2 * x


# Its own first derivative is right, and that derivative's derivative is not.
@slope.defjvp
def _(primals, tangents):
    (x,), (tangent,) = primals, tangents
    return 2 * x, 2.5 * tangent


@jax.custom_jvp
def wrong_curvature(x):
    return x**2


@wrong_curvature.defjvp
def _(primals, tangents):
    (x,), (tangent,) = primals, tangents
    return x**2, slope(x) * tangent


class Lamp(eqx.Module):
    position: jax.Array
    name: str = eqx.field(static=True, default="lamp")
    count: int = 2
    on: bool = True
    colour: None = None


class Room(eqx.Module):
    lights: tuple[Lamp, ...]


def test_the_worst_entry_is_named_by_its_path_with_the_numbers():
    room = Room((Lamp(jnp.array([1.0, 2.0, 3.0])), Lamp(jnp.array([1.0, 1.0, 1.0]))))

    def function(room):
        first, second = room.lights
        return jnp.sum(first.position) + wrong_slope(second.position[2])

    with pytest.raises(AssertionError) as error:
        check_gradients(function, room)
    assert str(error.value).startswith(
        "gradient at .lights[1].position[2]: forward 3, finite differences 2, reverse 3"
    )
    assert "1 of 6 entries" in str(error.value)


@pytest.mark.parametrize(
    "function, point, message",
    [
        (wrong_slope, np.float64(1.0), r"gradient at point: "),
        (lambda x: wrong_slope(x["a"][1, 0]), {"a": np.ones((2, 2))}, r"\['a'\]\[1, 0"),
        (wrong_curvature, 1.0, "second derivative at point and point: forward 2.5"),
        (lambda x: jnp.sqrt(x[0] - 1.0), [1.0], r"gradient at \[0\]: .*inf"),
        (lambda x: jnp.log(x - 2), 1.0, "function: .* not finite: nan"),
        (jnp.abs, 0.0, "gradient at point: forward .*, finite differences 0"),
    ],
)
def test_a_wrong_derivative_is_found(function, point, message):
    with pytest.raises(AssertionError, match=message):
        check_gradients(function, point)


def test_reverse_mode_alone_may_be_wrong():
    # JAX refuses forward mode through a custom_vjp: that is an error, not a pass.
    with pytest.raises(TypeError, match="custom_vjp"):
        check_gradients(wrong_reverse, np.ones(2))


def test_first_order_does_not_look_at_the_second():
    check_gradients(wrong_curvature, 1.0, order=1)


def test_at_a_kink_the_two_modes_are_compared():
    check_gradients(lambda x: jnp.maximum(x, 0), 0.0, finite_differences=False)
    with pytest.raises(AssertionError, match="gradient"):
        check_gradients(lambda x: x**2 * jnp.sqrt(x), 0.0, finite_differences=False)


def test_errors_of_two_outputs_do_not_cancel():
    def function(x):
        return jnp.stack([wrong_slope(x), -wrong_slope(x)])

    with pytest.raises(AssertionError):
        check_gradients(function, 1.0)


def test_what_is_no_float_is_left_alone():
    def function(point):
        number, flag, name, nothing, x = point
        assert (number, flag, name, nothing) == (3, True, "name", None)
        return x**number

    check_gradients(function, (3, True, "name", None, 1.5))


@pytest.mark.parametrize(
    "arguments, name",
    [
        ((jnp.sin, 3), "point"),
        ((jnp.sin, (None, "a")), "point"),
        ((jnp.sin, 1j), "point"),
        ((lambda x: jnp.sin(x).astype(jnp.float32), 1.0), "function"),
    ],
)
def test_nothing_to_check_is_an_error(arguments, name):
    with pytest.raises(ValueError, match=f"^{name}: "):
        check_gradients(*arguments)


def test_order():
    with pytest.raises(ValueError, match="^order: expected 1 or 2, got 3"):
        check_gradients(jnp.sin, 1.0, order=3)
