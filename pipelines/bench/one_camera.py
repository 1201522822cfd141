"""One camera beside COLMAP's pinholes: by how much the lead of a rig shrinks.

    python pipelines/bench/one_camera.py

The surveys of the bench, and what their first camera alone saw of them: CPU per
observation and iteration on one thread, of the iterations alone, in turns.
"""

import tempfile

import peers
import surveys

SIZES = (20, 100)


def main() -> None:
    print("| survey | observations | COLMAP, us | uwsfm, us | ratio |")
    print("|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for size in SIZES:
            whole = surveys.load(size, folder)
            for name, scene in (
                (f"{size} frames of two cameras", whole),
                (f"{size} images of one camera", surveys.of_one_camera(whole)),
            ):
                row = peers.beside_pinholes(scene)
                theirs, ours = (
                    row[f"{key}us_per_observation"] for key in ("", "ours_")
                )
                print(
                    f"| {name} | {row['observations']} | {theirs:.2f} | {ours:.2f} | "
                    f"{theirs / ours:.1f} x |"
                )


if __name__ == "__main__":
    main()
