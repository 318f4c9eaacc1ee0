"""Table of what files and folders of a capture are, by their names and what lies beside them (`folder_contents.py`)."""

from dataclasses import dataclass

PHOTOGRAPHS = (".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp", ".heic", ".heif", ".avif", ".jp2")
VIDEOS = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".mts", ".m2ts", ".3gp")
MASKS, REDUCED = "masks", "reduced copies"
RENDERED = b"rendered by bitymi-ns"
"""Comment in pictures and films of ns-render: frames are named as photographs are."""


@dataclass(frozen=True)
class Kind:
    """Name files or folders, and say what they are."""

    names: str
    """Patterns of a shell, in lower case; NAME stands for the name of a photograph or folder."""
    what: str  # in messages
    of: str = ""  # patterns, one of which lies beside it; empty = none has to
    use: str = ""  # what to do to have it used, in messages
    mark: bytes = b""  # that the file holds


DYNAMIC = Kind("dynamic_mask_NAME", "a mask of instant-ngp", "NAME")
MASK = Kind("NAME.mask NAME_mask NAME-mask", "a mask", "NAME")
PICTURES = (
    Kind("thumb thumb_[0-9]* thumbnail thumbnail_[0-9]*", "a thumbnail"),
    Kind("material_0 textured_output", "a texture"),
    Kind("depth_[0-9]* *[._-]depth", "a depth map"),
    Kind("conf_[0-9]*", "a confidence map"),
    DYNAMIC,
    MASK,
    Kind("NAME[._-]masked NAME[._-]undistorted", "a copy", "NAME"),
    Kind("NAME_ms_g NAME_ms_r NAME_ms_re NAME_ms_nir", "another band", "NAME_d"),
    Kind("NAME_gre NAME_red NAME_reg NAME_nir", "another band", "NAME_rgb"),
    Kind("dji_NAME[1-5].tif", "another band", "dji_NAME0.jpg"),
    Kind("NAME_t", "a thermal picture", "NAME_v NAME_w"),
    Kind("dji_*_NAME_t", "a thermal picture", "dji_*_NAME_v dji_*_NAME_w"),  # their seconds may differ
)
"""Pictures that are no photographs, by their names with or without ending; NAME by that of a picture beside them."""
FOLDERS = (
    Kind("masks mask masks_[0-9]*", MASKS, use="`bitymi-data --masks-path` uses them"),
    Kind("depth depths depth_maps", "depth maps"),
    Kind("confidence confidences conf", "confidence maps"),
    Kind("normal normals normal_maps", "normal maps"),
    Kind("segmentation segmentations semantic", "segmentations"),
    Kind("thumbnail thumbnails thumbs @eadir", "thumbnails"),
    Kind("sparse colmap dense stereo distorted", "a model"),
    Kind("opensfm odm_*", "a project of ODM"),
    Kind("outputs renders exports wandb", "results of programs"),
    Kind("planar_projections", "pictures made of panoramas"),
    Kind("NAME_2 NAME_4 NAME_8 NAME_16", REDUCED, "NAME", "`bitymi-data --downscale-factor` uses them"),
    Kind("2x 4x 8x 16x", REDUCED, "1x"),
    Kind("NAME_masked NAME_undistorted", "copies", "NAME"),
    Kind("NAME", "raw copies of corrected pictures", "corrected_NAME"),
)
"""Folders without photographs; NAME of a folder beside them."""
OF_MASKS = (DYNAMIC, MASK, FOLDERS[0])
RESULTS = (
    Kind("bundle.json", "pictures of a bundle", mark=b'"bitymi-bundle"'),
    Kind("config.yml", "pictures of a training run", mark=b"!!python/object"),
    Kind("pictures.json", "pictures of `bitymi bench pictures`", mark=b'"bitymi_pictures"'),
    Kind("transforms_eval.json", "pictures beside cameras of ns-export", mark=b'[\n    {\n        "file_path"'),
    Kind("gt-* raw-* accumulation beta overdraw expected_depth", "renders of ns-render"),
)
"""Files and folders that mark a folder as a result."""
BUNDLE, RUN, _, _, RENDERS = RESULTS
FILM = Kind("", "a film of ns-render")
SPLITS = ("train", "val", "test", "train+test")  # folders of ns-render, in which those of the last row mark it
UNREAD = (
    Kind("*.dng *.cr2 *.cr3 *.nef *.arw *.raf *.orf *.rw2 *.pef *.srw", "raw data of a camera", use="save it as JPEG"),
    Kind("*.jxl *.exr *.hdr *.psd", "no format of photographs", use="save it as JPEG or TIFF"),
    Kind("*.insp", "two fisheyes of Insta360's", use="export a 360-degree JPEG with Insta360 Studio"),
    Kind("*.insv *.360", "a film of two fisheyes", use="export a 360-degree MP4 with the camera's program"),
)
"""Images and films that cannot be read."""
OTHERS = (
    Kind("*.bitymi", "a bundle in one file, not a capture", use="give the folder of its photographs"),
    Kind("*.zip *.tar *.7z *.gz *.rar", "an archive", use="unpack it, and give the folder"),
    Kind("meta_data.json", "of sdfstudio", use="give `sdfstudio-data` after the options of the method"),
)
"""Files that are no captures, but lead to some."""
_PROCESS = "`ns-process-data {0} --output-dir NEW`, which needs the program ffmpeg, converts it"
_COLMAP = "`{0}` writes a COLMAP model"
_MATRICES = (
    "write each as 4 x 4 numbers, camera to world with OpenCV axes, to `pose/NAME.txt` beside `rgb/NAME.png`, and the "
    "camera matrix to `intrinsics.txt`"
)
POSES = (
    Kind("*.xml", "Metashape", use=_PROCESS.format("metashape --data IMAGES --xml FILE"), mark=b"<camera "),
    Kind("*.csv", "RealityCapture", use=_PROCESS.format("realitycapture --data IMAGES --csv FILE"), mark=b"#name,x,y"),
    Kind("*.xmp", "RealityCapture", use="export the registration as COLMAP or as CSV instead", mark=b"xcr:Rotation"),
    Kind("shots.geojson", "ODM", use=_PROCESS.format("odm --data FOLDER")),
    Kind("reconstruction.json", "OpenSfM", use=_COLMAP.format("opensfm export_colmap")),
    Kind("sfm_data.json", "OpenMVG", use=_COLMAP.format("openMVG_main_openMVG2Colmap -i FILE -o sparse/0")),
    Kind("cameras.sfm", "Meshroom", use=_COLMAP.format("aliceVision_exportColmap -i FILE -o NEW")),
    Kind("bundle.out bundle.rd.out", "Bundler", use=_MATRICES), Kind("*.nvm", "VisualSFM", use=_MATRICES),
    Kind("poses_bounds.npy", "LLFF", use=_MATRICES), Kind("cameras_sphere.npz", "NeuS", use=_MATRICES),
    Kind("cameras.npz", "IDR", use=_MATRICES),
    Kind("poses.txt traj.txt", "KITTI or Replica", use=_MATRICES),
    Kind("groundtruth.txt cameratrajectory.txt keyframetrajectory.txt", "TUM", use=_MATRICES),
    Kind("geo.txt", "positions of ODM", use="write them to the photographs' EXIF, as with exiftool", mark=b"EPSG"),
)  # fmt: skip
"""Files of poses that are not read, by program; IMAGES and FOLDER are those of the photographs and of the capture."""
IMAGES_OF = (
    Kind("NAME/distorted/sparse NAME/distorted/sparse/*", "NAME/input"),
    Kind("NAME/sparse NAME/sparse/[0-9]*", "NAME/images"),
)
"""Folders of COLMAP models, and of the pictures that belong to them."""
CLOUDS = (Kind("*.ply", "a point cloud", use="--ply-path"),)
LISTS = (
    Kind("train_list.txt", "train"),
    Kind("val_list.txt validation_list.txt", "val"),
    Kind("test_list.txt", "test"),
)
"""Lists of names of photographs, beside a COLMAP model, by split."""
NSVF = (Kind("0_*", "train"), Kind("1_*", "val"), Kind("2_*", "test"))
PROCESSED = (Kind("frame_train_*", "train"), Kind("frame_eval_*", "test"))
"""Names of photographs by split: of NSVF, and of ns-process-data."""
