"""python -m dem_jax buckets"""

from typing import TYPE_CHECKING

from dem_jax.cli.arguments import Args, Commands, create_command

if TYPE_CHECKING:
    from dem_jax.assembly.bucket_fill import BucketFill
    from dem_jax.scene import Scene


def add_command(commands: Commands) -> None:
    """Add the command to the parser."""
    made = create_command(
        commands,
        "buckets",
        show_buckets,
        "List the buckets that a scene can name, or print the keys of one.",
        now="list buckets",
    )
    made.add_argument("name", nargs="?", metavar="BUCKET", help="print its keys")


def show_buckets(args: Args) -> None:
    """List the buckets with their sizes, or print one."""
    from dem_jax.scene import library, load_scene
    from dem_jax.scene.bucket_geometry import bucket_volume
    from dem_jax.scene.scene import Scene

    def with_name(name: str) -> Scene:
        return load_scene("weigh-bucket", {"bucket": name})

    if args.name:
        with_name(args.name)
        print(library.find_bucket_file(args.name).read_text(encoding="utf-8"), end="")
        print(f"\n# {_weigh_bucket_fill(with_name(args.name))} with the portion of weigh-bucket")
        return
    known = library.list_buckets()
    wide = max(map(len, known))
    print(
        f"{'bucket':{wide}}  {'litres':>6}  {'mouth (mm)':>10}  {'drop (m)':>8}  {'opens (s)':>9}  {'full (%)':>8}  what it is"
    )
    for name, text in known.items():
        scene = with_name(name)
        weigh, feed = scene.weigh_bucket, scene.feed_bucket
        assert weigh and feed  # as the stock scene has them
        mouth = " x ".join(f"{1e3 * edge:g}" for edge in weigh.opening_size)
        litres, time, full = (
            1e3 * bucket_volume(weigh),
            feed.opening_time,
            100 * _weigh_bucket_fill(scene).fill_level,
        )
        print(
            f"{name:{wide}}  {litres:6.2g}  {mouth:>10}  {scene.drop.height:8g}  {time:9g}  {full:8.0f}  {text}"
        )
    print(
        "litres of the weigh bucket to its brim, and its mouth; full: of 50 g of marshmallows, the portion of weigh-bucket."
    )
    print("Sizes are assumed. --set bucket=NAME takes one")


def _weigh_bucket_fill(scene: "Scene") -> "BucketFill":
    """Describe how full the scene's portion makes the weigh bucket."""
    from dem_jax.assembly import bucket_fill
    from dem_jax.assembly.piece_arrays import build_piece_set

    return bucket_fill.list_bucket_fills(scene, build_piece_set(scene))[-1]
