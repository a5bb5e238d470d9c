import pytest

from turbnet.data.boxes import TextBox, read_boxes, write_boxes
from turbnet.errors import InputError

HEADER = "file\tleft\ttop\twidth\theight\ttext\n"


def test_written_boxes_are_read_again(tmp_path):
    boxes = {
        "a.png": [TextBox(1, 2, 30, 9, "two words"), TextBox(0, 0, 5, 5, 'quo"te')],
        "b/c.gif": [TextBox(7, 8, 9, 10, "é#")],
    }
    write_boxes(tmp_path / "boxes.tsv", boxes)
    assert read_boxes(tmp_path / "boxes.tsv") == boxes


def test_remarks_and_empty_lines(tmp_path):
    (tmp_path / "boxes.tsv").write_text("# a remark\n\n" + HEADER + "# another\na\t1\t2\t3\t4\tw\n")
    assert read_boxes(tmp_path / "boxes.tsv") == {"a": [TextBox(1, 2, 3, 4, "w")]}


def test_grown():
    assert TextBox(5, 6, 10, 4, "w").grown(2) == TextBox(3, 4, 14, 8, "w")


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("", "first line must name the columns file left top"),
        ("a\t1\t2\t3\t4\tw\n", "first line must name the columns"),
        (HEADER, "no boxes below the header"),
        (HEADER + "a\t1\t2\t3\tw\n", "line 2: not a file, four whole numbers and a text"),
        (HEADER + "a\t1\t2\t3.5\t4\tw\n", "line 2: not a file, four whole"),
        (HEADER + "a\t1\t2\t0\t4\tw\n", "line 2: the box is empty or has no text"),
        (HEADER + "a\t1\t2\t3\t4\t \n", "line 2: the box is empty or has no text"),
    ],
)
def test_bad_tables(tmp_path, content, says):
    (tmp_path / "boxes.tsv").write_text(content)
    with pytest.raises(InputError, match=says):
        read_boxes(tmp_path / "boxes.tsv")


def test_missing_table(tmp_path):
    with pytest.raises(InputError, match="cannot read the boxes"):
        read_boxes(tmp_path / "none.tsv")
    (tmp_path / "binary.tsv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="cannot read the boxes"):
        read_boxes(tmp_path / "binary.tsv")
