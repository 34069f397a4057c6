"""python -m dem_jax buckets"""

from typing import TYPE_CHECKING

from dem_jax.cli.arguments import Args, Commands, command

if TYPE_CHECKING:
    from dem_jax.build.bucket_fill import Fill
    from dem_jax.scene import Scene


def add(commands: Commands) -> None:
    """Add the command to the parser."""
    made = command(commands, "buckets", buckets, "List the buckets that a scene can name, or print the keys of one.")
    made.add_argument("name", nargs="?", metavar="BUCKET", help="print its keys")


def buckets(args: Args) -> None:
    """List the buckets with their sizes, or print one."""
    from dem_jax.scene import library, load_scene
    from dem_jax.scene.buckets import volume
    from dem_jax.scene.scene import Scene

    def with_name(name: str) -> Scene:
        return load_scene("weigh-bucket", {"bucket": name})

    if args.name:
        with_name(args.name)
        print(library.bucket_file(args.name).read_text(encoding="utf-8"), end="")
        print(f"\n# {_fill(with_name(args.name))} with the portion of weigh-bucket")
        return
    known = library.buckets()
    wide = max(map(len, known))
    print(f"{'bucket':{wide}}  {'litres':>6}  {'mouth (mm)':>10}  {'drop (m)':>8}  {'opens (s)':>9}  {'full (%)':>8}  what it is")
    for name, text in known.items():
        scene = with_name(name)
        weigh, feed = scene.weigh_bucket, scene.feed_bucket
        assert weigh and feed  # as the stock scene has them
        mouth = " x ".join(f"{1e3 * edge:g}" for edge in weigh.mouth)
        litres, time, full = 1e3 * volume(weigh), feed.opening_time, 100 * _fill(scene).level
        print(f"{name:{wide}}  {litres:6.2g}  {mouth:>10}  {scene.drop.height:8g}  {time:9g}  {full:8.0f}  {text}")
    print("litres of the weigh bucket to its brim, and its mouth; full: of 50 g of marshmallows, the portion of weigh-bucket.")
    print("Sizes are assumed. --set bucket=NAME takes one")


def _fill(scene: "Scene") -> "Fill":
    """How full the scene's portion makes the weigh bucket."""
    from dem_jax.build import bucket_fill
    from dem_jax.build.pieces import goods_of

    return bucket_fill.fills_of(scene, goods_of(scene))[-1]
