"""User input: sections of a scene, TOML in and out, buckets and placement of pieces."""

from dem_jax.scene.files import STOCK, load_scene, load_section, parse_scene, stock_scenes
from dem_jax.scene.messages import describe_allowed, describe_scene
from dem_jax.scene.scene import Scene
from dem_jax.scene.sections.base import (
    NotNegative,
    Points,
    Positive,
    Quaternion,
    Section,
    Size,
    Vector,
)
from dem_jax.scene.sections.bucket import Bucket, Drop, Feeder, LoadCell, WeighBucket
from dem_jax.scene.sections.inlet_outlet import Inlet, Outlet
from dem_jax.scene.sections.material import Material, NamedMaterial, Pair
from dem_jax.scene.sections.noise_settings import Noise
from dem_jax.scene.sections.piece import (
    SHAPE_KEYS,
    BodyMass,
    ConvexShape,
    Part,
    Piece,
    PieceShape,
    Portion,
    Product,
)
from dem_jax.scene.sections.run_settings import Accuracy, Error, RunSettings
from dem_jax.scene.sections.wall import Drive, Motion, Region, Wall
from dem_jax.scene.tree_merging import parse_setting

__all__ = [
    "Accuracy",
    "Region",
    "BodyMass",
    "Bucket",
    "ConvexShape",
    "Drive",
    "Drop",
    "Error",
    "Feeder",
    "Inlet",
    "LoadCell",
    "Material",
    "Motion",
    "NamedMaterial",
    "Noise",
    "NotNegative",
    "Outlet",
    "Pair",
    "Part",
    "Piece",
    "PieceShape",
    "Points",
    "Portion",
    "Positive",
    "Product",
    "Quaternion",
    "RunSettings",
    "SHAPE_KEYS",
    "STOCK",
    "Scene",
    "Section",
    "Size",
    "Vector",
    "Wall",
    "WeighBucket",
    "describe_allowed",
    "describe_scene",
    "load_scene",
    "load_section",
    "parse_scene",
    "parse_setting",
    "stock_scenes",
]
