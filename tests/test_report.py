import json
import math

import numpy as np
import pytest

from turbnet.errors import InputError
from turbnet.report import Report, Row


def test_schema_and_values(tmp_path):
    report = Report(command="turbnet bench")
    report.add(Row("seconds", np.float32(0.5), "s"))
    report.add(Row("frames", np.int64(3)))
    report.add(Row("psnr", math.inf, "dB"))
    report.add(Row.compared("r0", 1.02, 1.0, 0.05, "m"))
    report.write(tmp_path / "m.json")
    document = json.loads((tmp_path / "m.json").read_text())
    assert list(document) == ["version", "command", "machine", "rows"]
    assert [row["value"] for row in document["rows"]] == [0.5, 3, "inf", 1.02]
    assert document["rows"][3] == {
        "name": "r0", "value": 1.02, "unit": "m", "reference": 1.0, "tolerance": 0.05, "ok": True,
    }  # fmt: skip
    assert set(document["machine"]) == {"system", "processor", "cores", "python"}


@pytest.mark.parametrize(("value", "ok"), [(1.04, True), (0.96, True), (1.06, False), (0.94, False), (math.nan, False)])
def test_verdict_is_two_sided(value, ok):
    report = Report([Row("other", 1.0)])
    assert report.add(Row.compared("r0", value, 1.0, 0.05)).ok is ok
    assert report.ok is ok


def test_unwritable_file(tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        Report().write(tmp_path / "none" / "m.json")
