"""What goes wrong because of what a user gave. The command line prints it in one line and exits with 2."""


class InputError(ValueError):
    """The input cannot be used: says what is wrong and what to do about it."""


class ParameterError(InputError):
    """A parameter lies outside its physical or documented range."""


def check_range(name: str, value: float, low: float, high: float, unit: str = "") -> float:
    """Return `value` if `low <= value <= high`.

    Raises:
        ParameterError: names the parameter, its value and the accepted range. NaN is out of any range.
    """
    if not low <= value <= high:
        unit = f" {unit}" if unit else ""
        raise ParameterError(f"{name} = {value:g}{unit} is outside the accepted range {low:g} to {high:g}{unit}")
    return float(value)
