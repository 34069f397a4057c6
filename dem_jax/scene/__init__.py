"""User input: sections of a scene, TOML in and out, buckets and placement of pieces."""

from dem_jax.scene.changes import parse_setting
from dem_jax.scene.files import STOCK, load_scene, load_section, parse, stock_scenes
from dem_jax.scene.scene import Scene
from dem_jax.scene.sections.base import NotNegative, Points, Positive, Quaternion, Section, Size, Vector
from dem_jax.scene.sections.buckets import Bucket, Drop, Feeder, LoadCell, WeighBucket
from dem_jax.scene.sections.exchange import Inlet, Outlet
from dem_jax.scene.sections.material import Material, NamedMaterial, Pair
from dem_jax.scene.sections.noise import Noise
from dem_jax.scene.sections.pieces import SHAPE_KEYS, BodyMass, ConvexShape, Part, Piece, PieceShape, Portion, Product
from dem_jax.scene.sections.run import Accuracy, Error, RunSettings
from dem_jax.scene.sections.walls import Block, Drive, Motion, Wall
from dem_jax.scene.words import allowed, described

__all__ = [
    "Accuracy",
    "Block",
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
    "allowed",
    "described",
    "load_scene",
    "load_section",
    "parse",
    "parse_setting",
    "stock_scenes",
]
