"""Parameter files: bit for bit, and refused when damaged, foreign or of another network."""

import numpy as np
import pytest

from ddgrasp.errors import UserError
from learning.params import load_params, save_params


def test_parameters_round_trip_bit_for_bit(tmp_path):
    tree = {
        "dense": {"kernel": np.random.default_rng(0).normal(size=(3, 2)).astype(np.float32)},
        "step": np.int32(7),
    }
    save_params(tmp_path / "p.msgpack", tree)
    read = load_params(tmp_path / "p.msgpack")
    np.testing.assert_array_equal(read["dense"]["kernel"], tree["dense"]["kernel"])
    assert read["step"] == 7
    shaped = load_params(tmp_path / "p.msgpack", target=tree)
    np.testing.assert_array_equal(shaped["dense"]["kernel"], tree["dense"]["kernel"])
    with pytest.raises(UserError, match="does not fit"):
        load_params(tmp_path / "p.msgpack", target={"dense": {"other": np.zeros(3)}, "step": 0})
    other = {"dense": {"kernel": np.zeros((3, 5), np.float32)}, "step": np.int32(0)}
    with pytest.raises(UserError, match=r"does not fit .*the network's \(3, 5\)"):
        load_params(tmp_path / "p.msgpack", target=other)


def test_damaged_truncated_or_foreign_parameters_are_refused(tmp_path):
    path = tmp_path / "p.msgpack"
    save_params(path, {"a": np.zeros(100)})
    data = path.read_bytes()
    for damaged in (data[:-10], data[:-1] + bytes([data[-1] ^ 1]), data[:20]):
        path.write_bytes(damaged)
        with pytest.raises(UserError, match=r"p\.msgpack is damaged or truncated"):
            load_params(path)
    path.write_bytes(b"PK\x03\x04 something else")
    with pytest.raises(UserError, match="is no parameter file of this project"):
        load_params(path)
    with pytest.raises(UserError, match="does not exist"):
        load_params(tmp_path / "absent")
