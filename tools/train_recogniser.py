"""Train the built-in recogniser: one command, resumable, about half an hour on one core.

    python tools/train_recogniser.py [--steps 5000] [--output outputs/recogniser] [--threads 1]

Trains on lines rendered in the fonts that come with matplotlib and blurred on the fly, goes on from the last checkpoint
if there is one, measures the result on lines it has never seen, and writes turbnet/weights/recogniser.onnx with its card.
"""

import argparse
import io
from pathlib import Path

import numpy as np
import onnx
import torch
import torch.nn.functional as F
from torch import Tensor

from turbnet.data.text import fonts
from turbnet.data.text_lines import Lines, TextLines
from turbnet.data.words import ALPHABET
from turbnet.deploy.card import RecogniserCard
from turbnet.deploy.export import TOLERANCE, flush_denormals, quiet_exporter, sealed
from turbnet.media.atomic import atomic_path
from turbnet.metrics.ocr_builtin import Recogniser
from turbnet.metrics.text import edit_distance
from turbnet.nets.crnn import CRNN, LINE_HEIGHT, STRIDE, decode, encode
from turbnet.progress import progress_bar

BATCH, PEAK_RATE, SEED, SAVE_EVERY = 64, 3e-3, 0, 250
SEVERITIES, TEST_BATCHES = (0.0, 0.25, 0.5, 0.75, 1.0), 4
FONTS = fonts()
TRAIN_FONTS, TEST_FONTS = [p for i, p in enumerate(FONTS) if i % 8 != 3], [p for i, p in enumerate(FONTS) if i % 8 == 3]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=5000)
    parser.add_argument("--output", type=Path, default=Path("outputs/recogniser"))
    parser.add_argument("--weights", type=Path, default=Path(__file__).parents[1] / "turbnet" / "weights")
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    options.output.mkdir(parents=True, exist_ok=True)

    network = train(options.steps, options.output / "last.pt")
    notes: dict[str, str | int] = {
        "data": "words and strings rendered in fonts of matplotlib, blurred by random point-spread functions",
        "recipe": f"python tools/train_recogniser.py --steps {options.steps}",
        "lines seen": options.steps * BATCH,
    }
    for severity in SEVERITIES:
        notes[f"character error rate at severity {severity}"] = f"{error_rate(network, severity):.3f}"
    notes["measured on"] = (
        f"{TEST_BATCHES * BATCH} lines in {len(TEST_FONTS)} fonts that were never trained on; severity 1 is "
        "D/r0 = 6 for letters of 20 pixels an em"
    )
    config = {"widths": list(network.widths), "hidden": network.hidden}
    path = options.weights / "recogniser.onnx"
    export(network, RecogniserCard(config, ALPHABET, LINE_HEIGHT, STRIDE, SEED, notes), path)
    Recogniser.load(path).card.write_beside(path)
    print(path.with_suffix(".md").read_text())


def train(steps: int, last: Path) -> CRNN:
    """The network after `steps` steps, from the checkpoint `last` on if there is one."""
    torch.manual_seed(SEED)
    network = CRNN().to(memory_format=torch.channels_last).train()
    optimizer = torch.optim.AdamW(network.parameters(), PEAK_RATE, weight_decay=1e-2)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, PEAK_RATE, steps, pct_start=0.1)
    first = 0
    if last.is_file():
        saved = torch.load(last, weights_only=True)
        network.load_state_dict(saved["network"])
        optimizer.load_state_dict(saved["optimizer"])
        schedule.load_state_dict(saved["schedule"])
        first = saved["step"]
    lines = TextLines(TRAIN_FONTS, LINE_HEIGHT, STRIDE, BATCH, SEED)
    with progress_bar() as progress:
        for step in progress.track(range(first, steps), total=steps, completed=first, description="training"):
            loss = ctc_loss(network, lines(step))
            optimizer.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(network.parameters(), 5.0)
            optimizer.step()
            schedule.step()
            if (step + 1) % SAVE_EVERY == 0 or step + 1 == steps:
                parts = {"network": network, "optimizer": optimizer, "schedule": schedule}
                state = {name: part.state_dict() for name, part in parts.items()} | {"step": step + 1}
                with atomic_path(last) as temporary:
                    torch.save(state, temporary)
                print(f"step {step + 1}: loss {float(loss):.3f}", flush=True)
    return network.eval()


def ctc_loss(network: CRNN, lines: Lines) -> Tensor:
    """Negative log-likelihood of the texts, a character."""
    with torch.autocast("cpu", torch.bfloat16):
        scores_BTK = network(lines.pictures.contiguous(memory_format=torch.channels_last))
    lengths = torch.tensor([len(text) for text in lines.texts])
    steps = torch.full((len(lengths),), scores_BTK.shape[1])
    targets = torch.tensor([index for text in lines.texts for index in encode(text)])
    return F.ctc_loss(scores_BTK.transpose(0, 1), targets, steps, lengths, zero_infinity=True)


@torch.no_grad()
def error_rate(network: CRNN, severity: float) -> float:
    """Edits a character on lines of one severity, in fonts that were never trained on."""
    lines, errors, characters = TextLines(TEST_FONTS, LINE_HEIGHT, STRIDE, BATCH, SEED + 1), 0, 0
    for number in range(TEST_BATCHES):
        batch = lines(number, severity)
        for text, best in zip(batch.texts, network(batch.pictures).argmax(-1).tolist(), strict=True):
            errors += edit_distance(decode(best), text)
            characters += len(text)
    return errors / characters


def export(network: CRNN, card: RecogniserCard, path: Path) -> None:
    """Write the sealed ONNX file, once onnxruntime has reproduced the network on sizes it was not exported with."""
    network = flush_denormals(network.to(memory_format=torch.contiguous_format)).eval()
    buffer = io.BytesIO()
    with quiet_exporter():  # the newer exporter cannot take a recurrent layer of free length apart
        torch.onnx.export(
            network,
            (torch.rand(3, 1, LINE_HEIGHT, 24 * STRIDE),),
            buffer,
            dynamo=False,
            input_names=["lines"],
            output_names=["scores"],
            dynamic_axes={"lines": {0: "batch", 3: "width"}, "scores": {0: "batch", 1: "steps"}},
            opset_version=20,
        )
    data = sealed(onnx.load_from_string(buffer.getvalue()), card)
    exported = Recogniser(data)
    for batch, width in ((1, 2 * STRIDE), (1, 31 * STRIDE), (4, 60 * STRIDE)):
        lines = torch.rand(batch, 1, LINE_HEIGHT, width)
        with torch.no_grad():
            difference = np.abs(network(lines).numpy() - exported.scores(lines.numpy())).max()
        print(f"{batch} lines, {width} wide: largest difference of onnxruntime from torch {difference:.1e}")
        if not difference <= TOLERANCE:
            raise SystemExit("onnxruntime and torch differ; nothing is written")
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


if __name__ == "__main__":
    main()
