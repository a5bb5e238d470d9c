"""Configurations and checkpoints that name code, variables or files of others."""

import os
import pickle
from types import SimpleNamespace

import pytest
import torch
import yaml

import turbnet.cli
from turbnet.errors import InputError
from turbnet.tasks.fit import check_resume
from turbnet.tasks.targets import check_hydra


@pytest.fixture
def refused(capfd, monkeypatch, tmp_path):
    """Runs turbnet train in an empty folder with a config of the given content: one line, exit code 2, no marker."""

    def run(*arguments, text="", **content):
        (tmp_path / "experiment").mkdir()
        (tmp_path / "experiment" / "odd.yaml").write_text("# @package _global_\n" + (text or yaml.safe_dump(content)))
        monkeypatch.chdir(tmp_path)
        arguments = arguments or ("--config-dir", str(tmp_path), "experiment=odd")
        assert turbnet.cli.run(["train", *arguments]) == 2
        said = capfd.readouterr()
        assert said.err.count("\n") == 1, said.err
        assert not (tmp_path / "marker").exists()
        return said.err

    return run


HOSTILE = {"_target_": "os.mkdir", "path": "marker"}


@pytest.mark.parametrize("part", ["callbacks", "net", "data", "task", "trainer"])
def test_a_config_makes_nothing_but_ours(refused, part):
    assert "os.mkdir" in refused(**{part: {"x": HOSTILE} if part == "callbacks" else HOSTILE})


def test_hydra_makes_nothing_before_the_run(refused):
    """Its callbacks would be made before turbnet sees the configuration."""
    assert "hydra.callbacks.x._target_" in refused(hydra={"callbacks": {"x": HOSTILE}})


def test_a_pickle_is_no_run_to_repeat(refused, tmp_path):
    class Runs:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "marker"),)

    (tmp_path / "config.pickle").write_bytes(pickle.dumps(Runs()))
    for flag in ("--experimental-rerun", "--exp"):
        assert "pickle" in refused(flag, str(tmp_path / "config.pickle"))
        (tmp_path / "experiment" / "odd.yaml").unlink()
        (tmp_path / "experiment").rmdir()


@pytest.mark.parametrize(
    "text", ["a: [1", "\t- x: {", "net: ${net", "[1, 2]", "x: &a [*a]", "x: " + "9" * 5000, "x: " + "[" * 5000]
)
def test_a_config_that_is_none(refused, text):
    assert refused(text=text).startswith("turbnet train: ")


BASIC = {"_target_": "hydra._internal.core_plugins.basic_launcher.BasicLauncher"}
CLUSTER = {
    "_target_": "hydra_plugins.hydra_submitit_launcher.submitit_launcher.SlurmLauncher",
    "setup": ["touch marker"],
}
HANDLER = {"class": "logging.FileHandler", "filename": "a.log", "stream": "ext://sys.stdout"}
COLOUR = {"()": "colorlog.ColoredFormatter"}


def of_hydra(asked=(), **parts):
    return {"overrides": {"hydra": list(asked)}, "launcher": BASIC, **parts}


@pytest.mark.parametrize(
    "config",
    [
        of_hydra(callbacks={"x": {"_target_": "turbnet.tasks.fit.fit"}}),
        of_hydra(callbacks={"x": {"_target_": "${oc.env:X}"}}),
        of_hydra(callbacks={"x": {"_target_": ["os.mkdir"]}}),
        of_hydra(sweeper={"_target_": "os.mkdir"}),
        of_hydra(launcher=CLUSTER),
        of_hydra(job={"env_set": {"LD_PRELOAD": "evil.so"}}),
        of_hydra(job_logging={"handlers": {"x": {"class": "logging.config.fileConfig", "fname": "evil.ini"}}}),
        of_hydra(job_logging={"formatters": {"x": {"()": "os.mkdir", "path": "marker"}}}),
        of_hydra(hydra_logging={"handlers": {"x": {**HANDLER, "stream": "ext://os.system"}}}),
    ],
)
def test_what_hydra_acts_on_itself(config):
    with pytest.raises(InputError, match="hydra"):
        check_hydra(config)


def test_what_hydra_may_be_told():
    check_hydra(of_hydra(job={"env_set": {}, "name": "x"}, callbacks={}))
    check_hydra(of_hydra(["hydra/launcher=submitit_slurm"], launcher=CLUSTER))
    check_hydra(of_hydra(job_logging={"handlers": {"file": HANDLER}, "formatters": {"colour": COLOUR}}))


@pytest.mark.parametrize("name", ["/etc/passwd", "{folder}/../other.txt", "s3://bucket/key"])
@pytest.mark.parametrize("field", ["best_model_path", "kth_best_model_path", "last_model_path", "best_k_models"])
def test_a_checkpoint_names_no_file_of_others_to_delete(tmp_path, name, field):
    """Lightning deletes what a callback remembers as its own, once there is a better one."""
    folder = tmp_path / "checkpoints"
    task = SimpleNamespace(hparams={"net": {"name": "dncnn"}}, trained=list)

    def resume(value):
        state = {"dirpath": str(folder), "best_model_path": "", "kth_best_model_path": "", "best_k_models": {}}
        state[field] = {value: torch.ones(1)} if field == "best_k_models" else value
        content = {
            "state_dict": {},
            "hyper_parameters": {"net": {"name": "dncnn"}},
            "optimizer_states": [{"param_groups": [{"params": []}]}],
            "callbacks": {"ModelCheckpoint": state},
        }
        torch.save(content, tmp_path / "last.ckpt")
        check_resume(str(tmp_path / "last.ckpt"), task)

    resume(f"{folder}/epoch0001.ckpt")
    with pytest.raises(InputError, match="does not lie in"):
        resume(name.format(folder=folder))


def test_a_checkpoint_without_an_optimiser(tmp_path):
    task = SimpleNamespace(hparams={"net": {"name": "dncnn"}}, trained=list)
    torch.save({"state_dict": {}, "hyper_parameters": {"net": {"name": "dncnn"}}}, tmp_path / "last.ckpt")
    with pytest.raises(InputError, match="cannot read .*optimizer_states"):
        check_resume(str(tmp_path / "last.ckpt"), task)
