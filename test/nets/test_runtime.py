"""Where networks run and in what arithmetic."""

import numpy as np
import pytest
import torch

from hat_ros.config import NetsConfig
from hat_ros.errors import ConfigError
from hat_ros.nets.runtime import Runtime, choose_device, device_of


@pytest.mark.parametrize("name", ["gpu", "cuda:99", "cpu:cpu", "mps", ""])
def test_unknown_devices_are_named(name):
    with pytest.raises(ConfigError, match=f"nets.device: '{name}'"):
        choose_device(name)


@pytest.mark.parametrize("precision", ["auto", "float32", "float16", "bfloat16"])
def test_the_cpu_computes_in_float32(precision):
    runtime = Runtime(NetsConfig(device="cpu", precision=precision), "droid", as_released=torch.float16)
    assert runtime.dtype == torch.float32 and not runtime.reduced_precision


def test_precision_on_an_accelerator_is_the_one_of_the_release_unless_named(monkeypatch):
    monkeypatch.setattr("hat_ros.nets.runtime.choose_device", lambda name: torch.device("cuda"))
    assert Runtime(NetsConfig(), "droid", as_released=torch.float16).dtype == torch.float16
    assert not Runtime(NetsConfig(), "droid").reduced_precision
    assert not Runtime(NetsConfig(precision="float32"), "droid", as_released=torch.float16).reduced_precision
    assert Runtime(NetsConfig(precision="bfloat16"), "droid").dtype == torch.bfloat16


@pytest.mark.parametrize(("n_images", "size"), [(0, 4), (1, 64), (20, 3), (20, 64)])
def test_batches_cover_every_image_once(n_images, size):
    batches = list(Runtime(NetsConfig(device="cpu"), "droid").batches(n_images, size))
    assert [i for batch in batches for i in range(n_images)[batch]] == list(range(n_images))
    assert all(batch.stop - batch.start <= size for batch in batches)


def test_tensors_of_read_only_arrays_are_copies(recwarn):
    array = np.arange(3, dtype=np.float32)
    array.flags.writeable = False
    tensor = Runtime(NetsConfig(device="cpu"), "droid").tensor(array)
    tensor[0] = 7
    assert array[0] == 0 and not recwarn.list


def test_a_placed_network_gives_the_same_numbers_and_needs_no_gradient():
    net = torch.nn.Sequential(torch.nn.Conv2d(3, 4, 3), torch.nn.BatchNorm2d(4))
    x = torch.rand(2, 3, 8, 8)
    with torch.inference_mode():
        expected = net.eval()(x)
        placed = Runtime(NetsConfig(device="cpu"), "droid").place(net)
        torch.testing.assert_close(placed(x), expected)
    assert not any(parameter.requires_grad for parameter in net.parameters())


def test_a_network_may_have_a_device_of_its_own():
    names = "cuda:0, droid=cuda:1,mask2former=cpu"
    assert [device_of(names, n) for n in ("megapose", "droid", "mask2former")] == ["cuda:0", "cuda:1", "cpu"]
    assert device_of("droid=cpu", "picopose") == "auto"
    with pytest.raises(ConfigError, match="'sam' is no network, known are mask2former"):
        device_of("cpu,sam=cuda", "droid")
