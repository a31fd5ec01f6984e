//! Small valid files of every format, from which mutations start. All of them are generated here; no file is
//! read.

use image::{DynamicImage, GrayAlphaImage, ImageBuffer, ImageFormat, LumaA, Rgb, Rgba, RgbaImage};
use sixfold_align::VerificationMesh;
use sixfold_bop::Rle;
use sixfold_estimator::ObjectRecord;
#[cfg(feature = "networks")]
use sixfold_experience::{Copy, Experience, ExperienceStore, SqliteStore};
#[cfg(feature = "networks")]
use sixfold_experience::{Crop, CropOptions};
#[cfg(feature = "networks")]
use sixfold_geometry::{Camera, Pose};
use sixfold_geometry::{Image, Mask, Vec3};
#[cfg(feature = "networks")]
use sixfold_grasp::Gripper;
use sixfold_io::{write_depth, write_mask, write_rgb};
use sixfold_mesh::{ContinuousSymmetry, Mesh, ModelInfo, PlyFormat, Unit, ply_bytes};
#[cfg(feature = "networks")]
use sixfold_mttm::{DepthView, ObjectTemplates, TemplateOptions};
use sixfold_ppf::{ModelOptions, ObjectModel};

fn texts(all: &[&str]) -> Vec<Vec<u8>> {
    all.iter().map(|text| text.as_bytes().to_vec()).collect()
}

/// The file that `write` makes.
fn made(name: &str, write: impl FnOnce(&std::path::Path)) -> Vec<u8> {
    let folder = tempfile::tempdir().expect("a temporary folder can be made");
    let path = folder.path().join(name);
    write(&path);
    std::fs::read(&path).expect("the seed was written")
}

/// A tetrahedron with edges of 5 to 7 cm.
pub(crate) fn tetrahedron() -> Mesh {
    let corners = vec![Vec3::zeros(), Vec3::x() * 0.05, Vec3::y() * 0.05, Vec3::z() * 0.05];
    Mesh::new(corners, vec![[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]).expect("a tetrahedron is a mesh")
}

/// Options for coarse descriptions, which are quick to compute.
pub(crate) fn coarse() -> ModelOptions {
    ModelOptions { sampling_step: 0.2, ..ModelOptions::default() }
}

pub(crate) fn ply() -> Vec<Vec<u8>> {
    let colored = tetrahedron().with_colors(vec![[10, 200, 30]; 4]).expect("a colour for each vertex");
    let square = "ply\nformat ascii 1.0\ncomment x\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n\
        property float nx\nproperty float ny\nproperty float nz\nproperty uchar red\nproperty uchar green\nproperty uchar blue\n\
        element face 1\nproperty list uchar int vertex_indices\nend_header\n\
        0 0 0 0 0 1 255 0 0\n10 0 0 0 0 1 0 255 0\n10 10 0 0 0 1 0 0 255\n0 10 0 0 0 1 9 9 9\n4 0 1 2 3\n";
    let big = b"ply\nformat binary_big_endian 1.0\nelement vertex 3\nproperty double x\nproperty double y\nproperty double z\n\
        element face 1\nproperty list uint8 uint32 vertex_index\nend_header\n";
    let mut big = big.to_vec();
    [0.0f64, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0].iter().for_each(|v| big.extend(v.to_be_bytes()));
    big.push(3);
    [0u32, 1, 2].iter().for_each(|v| big.extend(v.to_be_bytes()));
    vec![
        ply_bytes(&tetrahedron(), Unit::Millimetre, PlyFormat::Ascii, None),
        ply_bytes(&colored, Unit::Millimetre, PlyFormat::BinaryLittleEndian, None),
        square.as_bytes().to_vec(),
        big,
    ]
}

pub(crate) fn obj() -> Vec<Vec<u8>> {
    texts(&[
        "# a square\nv 0 0 0\nv 10 0 0\nv 10 10 0\nv 0 10 0\nf 1 2 3 4\n",
        "v 0 0 0 1 0 0\nv 10 0 0 0 1 0\nv 10 10 0 0 0 1\nvn 0 0 1\nf 1//1 2//1 -1//-1\n",
        "mtllib a.mtl\nnewmtl red\nKd 0.8 0.1 0.1\nmap_Kd a.png\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\n\
         usemtl red\nf 1/1 2/2 3/3\n",
    ])
}

pub(crate) fn stl() -> Vec<Vec<u8>> {
    let mut binary = vec![b' '; 80];
    binary.extend(2u32.to_le_bytes());
    for corners in
        [[0.0f32, 0.0, 0.0, 9.0, 0.0, 0.0, 0.0, 9.0, 0.0], [9.0, 0.0, 0.0, 9.0, 9.0, 0.0, 0.0, 9.0, 0.0]]
    {
        [0.0f32, 0.0, 1.0].iter().chain(&corners).for_each(|v| binary.extend(v.to_le_bytes()));
        binary.extend(0u16.to_le_bytes());
    }
    let ascii = "solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 10 0 0\nvertex 0 10 0\nendloop\nendfacet\nendsolid a\n";
    vec![binary, ascii.as_bytes().to_vec()]
}

pub(crate) fn gltf() -> Vec<Vec<u8>> {
    let mut bin = Vec::new();
    for v in [0.0f32, 0.0, 0.0, 1.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 1.0, 0.0] {
        bin.extend(v.to_le_bytes());
    }
    for index in [0u16, 1, 2, 0, 2, 3] {
        bin.extend(index.to_le_bytes());
    }
    let document = |buffer: &str| {
        format!(
            r#"{{"asset":{{"version":"2.0"}},"scene":0,"scenes":[{{"nodes":[0]}}],"nodes":[{{"mesh":0,"scale":[-1,1,1]}}],
"meshes":[{{"primitives":[{{"attributes":{{"POSITION":0}},"indices":1,"material":0}}]}}],
"materials":[{{"pbrMetallicRoughness":{{"baseColorFactor":[1,0.5,0,1]}}}}],
"accessors":[{{"bufferView":0,"componentType":5126,"count":4,"type":"VEC3","min":[0,0,0],"max":[1,1,0]}},
{{"bufferView":1,"componentType":5123,"count":6,"type":"SCALAR"}}],
"bufferViews":[{{"buffer":0,"byteOffset":0,"byteLength":48}},{{"buffer":0,"byteOffset":48,"byteLength":12}}],
"buffers":[{{"byteLength":60{buffer}}}]}}"#
        )
    };
    let mut json = document("").into_bytes();
    json.resize(json.len().next_multiple_of(4), b' ');
    let mut glb = b"glTF".to_vec();
    for part in [2, (12 + 8 + json.len() + 8 + bin.len()) as u32, json.len() as u32] {
        glb.extend(part.to_le_bytes());
    }
    glb.extend(b"JSON");
    glb.extend(json);
    glb.extend((bin.len() as u32).to_le_bytes());
    glb.extend(b"BIN\0");
    glb.extend(bin);
    let inside = document(
        r#","uri":"data:application/octet-stream;base64,AAAAAAAAAAAAAAAAAACAPwAAAAAAAAAAAACAPwAAgD8AAAAAAAAAAAAAgD8AAAAAAAABAAIAAAACAAMA""#,
    );
    vec![glb, inside.into_bytes()]
}

pub(crate) fn xyz() -> Vec<Vec<u8>> {
    texts(&["# points\n0 0 0\n10 0 0\n0,10,0\n", "0 0 0 0 0 1\n10 0 0 0 0 1\n0 10 0 0 0 1\n"])
}

pub(crate) fn models_info() -> Vec<Vec<u8>> {
    texts(&[
        r#"{"1": {"diameter": 102.1, "min_x": -38, "min_y": -39, "min_z": -46, "size_x": 76, "size_y": 78, "size_z": 92}}"#,
        r#"{"10": {"diameter": 164.6, "min_x": -50, "min_y": -90, "min_z": -34, "size_x": 100, "size_y": 181, "size_z": 68,
"symmetries_discrete": [[-1,0,0,0, 0,-1,0,0, 0,0,1,0, 0,0,0,1]],
"symmetries_continuous": [{"axis": [0, 0, 1], "offset": [0, 0, 0]}]}}"#,
    ])
}

pub(crate) fn scene_files() -> Vec<Vec<u8>> {
    texts(&[
        r#"{"3": {"cam_K": [572.4, 0, 325.3, 0, 573.6, 242.0, 0, 0, 1], "depth_scale": 1.0,
"cam_R_w2c": [1,0,0,0,1,0,0,0,1], "cam_t_w2c": [0, 0, 700]}}"#,
        r#"{"3": [{"cam_R_m2c": [1,0,0,0,0,-1,0,1,0], "cam_t_m2c": [10, -20, 700], "obj_id": 5}], "4": []}"#,
        r#"{"3": [{"bbox_obj": [10, 20, 30, 40], "bbox_visib": [10, 20, 15, 40], "px_count_all": 900, "px_count_valid": 800,
"px_count_visib": 400, "visib_fract": 0.44}]}"#,
        r#"[{"im_id": 3, "inst_count": 1, "obj_id": 1, "scene_id": 2}, {"im_id": 4, "scene_id": 2}]"#,
    ])
}

pub(crate) fn coco() -> Vec<Vec<u8>> {
    texts(&[
        r#"[{"scene_id": 0, "image_id": 1, "category_id": 1, "score": 0.375, "bbox": [24, 1, 55, 8],
"segmentation": {"size": [480, 640], "counts": [2309, 5, 300000, 4886]}, "time": 0.1}]"#,
        r#"[{"image_id": 1, "category_id": 2, "score": 0.9, "bbox": [600, 400, 100, 100]}]"#,
        r#"{"images": [{"id": 1, "width": 640, "height": 480}], "categories": [{"id": 1}], "annotations": [{"id": 1, "image_id": 1,
"category_id": 1, "bbox": [20, 0, 60, 10], "area": 600, "iscrowd": 0, "ignore": false,
"segmentation": {"size": [480, 640], "counts": [2309, 5, 300000, 4886]}}]}"#,
    ])
}

pub(crate) fn rle() -> Vec<Vec<u8>> {
    let mask = Mask::from_fn(20, 12, |x, y| (3..9).contains(&x) && (2..7).contains(&y) && (x + y) % 5 > 0);
    let mut some = vec![20, 12];
    some.extend(Rle::encode(&mask).expect("a mask can be encoded").to_compressed().bytes());
    vec![some, vec![0, 0], b"\x05\x05`0".to_vec()]
}

pub(crate) fn results() -> Vec<Vec<u8>> {
    texts(&[
        "scene_id,im_id,obj_id,score,R,t,time\n2,3,1,0.9,1 0 0 0 1 0 0 0 1,10 -20 700,0.5\n2,4,5,-1,0 -1 0 1 0 0 0 0 1,1 2 3,-1\n",
        "2,3,1,0.9,1 0 0 0 1 0 0 0 1,10 -20 700,0.5\r\n",
    ])
}

/// Meta files of HO-3D: by Python 2, in text, and by Python 3 with a function of its own.
pub(crate) fn pickle() -> Vec<Vec<u8>> {
    let array = "cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(I0\ntS'b'\ntR(I1\n(I3\nI1\ntcnumpy\ndtype\n\
        (S'f4'\nI0\nI1\ntR(I3\nS'<'\nNNNI-1\nI-1\nI0\ntbI00\nS'\\x00\\x00\\x80?\\x00\\x00\\x00@\\x00\\x00@@'\ntb";
    let text = format!("(dp0\nS'objName'\np1\nS'003_cracker_box'\np2\nsS'objRot'\n{array}sS'camMat'\nNs.");
    let binary = b"\x80\x04\x95\x40\0\0\0\0\0\0\0}\x94(\x8c\x07objName\x94\x8c\x03004\x94\x8c\x06objRot\x94N\x8c\x01h\x94\
        \x8c\x05posix\x94\x8c\x06system\x94\x93\x94\x8c\x04true\x94\x85\x94R\x94u.";
    vec![text.into_bytes(), binary.to_vec()]
}

/// An HDF5 file with one dataset of 3x1 integers of 64 bits, `faces`.
pub(crate) fn hdf5() -> Vec<Vec<u8>> {
    let mut file = vec![0u8; 600];
    let mut put = |at: usize, bytes: &[u8]| file[at..at + bytes.len()].copy_from_slice(bytes);
    let number = |n: u64| n.to_le_bytes();
    // Superblock with the root's header at 96.
    put(0, b"\x89HDF\r\n\x1a\n\0\0\0\0\0\x08\x08\0\x04\0\x10\0");
    put(64, &number(96));
    // Root: one message, the symbol table with its tree at 136 and its heap at 200.
    put(96, b"\x01\0\x01\0\x01\0\0\0\x18\0\0\0\0\0\0\0\x11\0\x10\0\0\0\0\0");
    put(120, &number(136));
    put(128, &number(200));
    put(136, b"TREE\0\0\x01\0");
    put(168, &number(280));
    put(200, b"HEAP\0\0\0\0");
    put(208, &number(24));
    put(224, &number(240));
    put(248, b"faces\0");
    put(280, b"SNOD\x01\0\x01\0");
    put(288, &number(8));
    put(296, &number(340));
    // The dataset: three messages of 24, 16 and 24 bytes.
    put(340, b"\x01\0\x03\0\x01\0\0\0\x58\0\0\0\0\0\0\0");
    put(356, b"\x01\0\x18\0\0\0\0\0\x01\x02\0\0\0\0\0\0\x03\0\0\0\0\0\0\0\x01\0\0\0\0\0\0\0");
    put(388, b"\x03\0\x10\0\0\0\0\0\x10\x08\0\0\x08\0\0\0\0\0\x40\0\0\0\0\0");
    put(412, b"\x08\0\x18\0\0\0\0\0\x03\x01");
    put(422, &number(500));
    put(430, &number(24));
    put(500, &number(7));
    vec![file]
}

pub(crate) fn camera() -> Vec<Vec<u8>> {
    texts(&[
        r#"{"width": 640, "height": 480, "fx": 572.4, "fy": 573.6, "cx": 325.3, "cy": 242.0, "depth_scale": 1.0}"#,
        r#"{"cam_K": [572.4, 0, 325.3, 0, 573.6, 242.0, 0, 0, 1], "distortion": [0.1, -0.2, 0.001, 0.0, 0.05]}"#,
        r#"{"3": {"cam_K": [572.4, 0, 325.3, 0, 573.6, 242.0, 0, 0, 1], "depth_scale": 0.1}}"#,
        r#"{"camera_matrix": [[572.4, 0, 325.3], [0, 573.6, 242.0], [0, 0, 1]], "dist_coeffs": [[0.1, -0.2, 0.001, 0, 0.05]]}"#,
        "%YAML:1.0\n---\nimage_width: 640\nimage_height: 480\ncamera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   \
         data: [ 572.4, 0., 325.3, 0.,\n       573.6, 242., 0., 0., 1. ]\ndistortion_coefficients: !!opencv-matrix\n   rows: 5\n   \
         cols: 1\n   dt: d\n   data: [ 0.1, -0.2, 1.0e-03, 0., 0.05 ]\n",
        "<?xml version=\"1.0\"?>\n<opencv_storage>\n<camera_matrix type_id=\"opencv-matrix\">\n<rows>3</rows><cols>3</cols><dt>d</dt>\n\
         <data>572.4 0. 325.3 0. 573.6 242. 0. 0. 1.</data></camera_matrix>\n<dist_coeffs>0.1 -0.2 0.001 0. 0.05</dist_coeffs>\n\
         </opencv_storage>\n",
        "header:\n  stamp: {sec: 1, nanosec: 2}\n  frame_id: \"camera\" # comment\nheight: 480\nwidth: 640\ndistortion_model: plumb_bob\n\
         d:\n- 0.1\n- -0.2\n- 0.001\n- 0.0\n- 0.05\nk:\n  - 572.4\n  - 0.0\n  - 325.3\n  - 0.0\n  - 573.6\n  - 242.0\n  - 0.0\n  \
         - 0.0\n  - 1.0\nbinning_x: 0\nroi: {x_offset: 0, do_rectify: false}\n---\n",
    ])
}

/// The bytes of an image file.
fn encoded(image: DynamicImage, format: ImageFormat) -> Vec<u8> {
    let mut bytes = std::io::Cursor::new(vec![]);
    image.write_to(&mut bytes, format).expect("a small image can be encoded");
    bytes.into_inner()
}

pub(crate) fn images() -> Vec<Vec<u8>> {
    let written = "a small image can be written";
    vec![
        made("a.png", |p| {
            write_rgb(p, &Image::from_fn(9, 7, |x, y| [x as u8 * 9, y as u8, 7])).expect(written)
        }),
        made("a.png", |p| {
            write_depth(p, &Image::from_fn(9, 7, |x, _| x as f32 * 0.1), 0.001).expect(written)
        }),
        made("a.png", |p| write_mask(p, &Mask::from_fn(9, 7, |x, y| x > y)).expect(written)),
        encoded(
            RgbaImage::from_fn(9, 7, |x, y| Rgba([x as u8, 9, 0, 40 * y as u8])).into(),
            ImageFormat::Png,
        ),
        encoded(GrayAlphaImage::from_fn(9, 7, |x, y| LumaA([x as u8, 9 * y as u8])).into(), ImageFormat::Png),
        encoded(ImageBuffer::from_fn(9, 7, |x, _| Rgb([256 * x as u16, 0, 0])).into(), ImageFormat::Png),
        encoded(ImageBuffer::from_fn(9, 7, |x, _| Rgba([256 * x as u16, 0, 0, 1])).into(), ImageFormat::Png),
        encoded(image::RgbImage::from_fn(16, 8, |x, y| Rgb([x as u8, y as u8, 7])).into(), ImageFormat::Jpeg),
    ]
}

#[cfg(feature = "networks")]
pub(crate) fn weights() -> Vec<Vec<u8>> {
    let file = |header: &str, data: usize| {
        let mut bytes = (header.len() as u64).to_le_bytes().to_vec();
        bytes.extend(header.bytes());
        bytes.extend((0..data).map(|k| k as u8));
        bytes
    };
    vec![
        file(
            r#"{"__metadata__":{"sixfold_card":"{\"architecture\":\"a\",\"format_version\":1,\"steps\":12,\"scores\":{\"x\":0.5}}"},"a.weight":{"dtype":"F32","shape":[2,3],"data_offsets":[0,24]}}"#,
            24,
        ),
        file(
            r#"{"b":{"dtype":"F16","shape":[4],"data_offsets":[0,8]},"c":{"dtype":"I64","shape":[],"data_offsets":[8,16]}}"#,
            16,
        ),
    ]
}

pub(crate) fn ppf() -> Vec<Vec<u8>> {
    let description = made("object.sixfold-ppf", |path| {
        ObjectModel::cached(path, &tetrahedron(), &[], &coarse()).expect("a tetrahedron can be described");
    });
    vec![description]
}

/// A wavy sheet with a few more faces than the limit for rendering.
pub(crate) fn fine() -> Mesh {
    let side = 46u32;
    let at = |i: u32| {
        let (x, y) = (f64::from(i % side) * 1e-3, f64::from(i / side) * 1e-3);
        Vec3::new(x, y, 0.002 * (300.0 * x).sin() * (200.0 * y).cos())
    };
    let faces = (0..(side - 1) * (side - 1)).flat_map(|k| {
        let i = k / (side - 1) * side + k % (side - 1);
        [[i, i + 1, i + side], [i + 1, i + side + 1, i + side]]
    });
    Mesh::new((0..side * side).map(at).collect(), faces.collect()).expect("a sheet is a mesh")
}

pub(crate) fn verification_mesh() -> Vec<Vec<u8>> {
    let kept = made("verification-mesh.bin", |path| {
        VerificationMesh::cached(Some(path), &fine()).expect("a sheet has a surface");
    });
    vec![kept]
}

pub(crate) fn object_record() -> Vec<Vec<u8>> {
    let mesh = tetrahedron();
    let mut info = ModelInfo::of_mesh(&mesh);
    info.symmetries_discrete.push(sixfold_geometry::Pose::exp(&[0.0, 0.0, 0.0, 0.0, 0.0, 3.0].into()));
    info.symmetries_continuous.push(ContinuousSymmetry { axis: Vec3::z(), offset: Vec3::zeros() });
    let record = ObjectRecord::of_mesh("a.ply".as_ref(), Unit::Metre, &mesh, &info);
    vec![serde_json::to_vec_pretty(&record).expect("a record can be written")]
}

pub(crate) fn object_mesh() -> Vec<Vec<u8>> {
    vec![ply_bytes(&tetrahedron(), Unit::Metre, PlyFormat::BinaryLittleEndian, None)]
}

#[cfg(feature = "networks")]
pub(crate) fn templates() -> Vec<Vec<u8>> {
    let camera = Camera::new(575.0, 575.0, 159.5, 119.5, 320, 240).expect("a camera");
    let mask = Mask::from_fn(320, 240, |x, y| (120..180).contains(&x) && (90..150).contains(&y));
    let depth = Image::from_fn(320, 240, |x, y| {
        let inside = (120..180).contains(&x) && (90..150).contains(&y);
        if inside { 0.7 + 0.0003 * x as f32 } else { 0.9 }
    });
    let made = |camera_from_object| {
        let view = DepthView { depth: &depth, camera: &camera, mask: &mask, camera_from_object };
        let templates = ObjectTemplates::from_depth(&[view], &TemplateOptions::default());
        templates.expect("a box in sight gives a template").to_bytes()
    };
    vec![made(None), made(Some(Pose::from_translation(Vec3::new(0.0, 0.0, 0.75))))]
}

pub(crate) fn gripper() -> Vec<Vec<u8>> {
    texts(&[r#"{"kind": "parallel-jaws", "name": "jaws-85", "max_opening": 0.085, "finger_length": 0.045,
"finger_width": 0.022, "finger_thickness": 0.010, "palm_width": 0.11, "palm_depth": 0.07, "palm_height": 0.10,
"force": 30.0, "friction": 0.5}"#])
}

pub(crate) fn haf() -> Vec<Vec<u8>> {
    texts(&[r#"{"kind":"haf-linear-1","card":{"seed":0},"probability":[1.5,-0.25],"bias":0.125,"features":[
{"weight":0.5,"regions":[[0,2,4,9,1.0]]},
{"weight":-2.0,"regions":[[6,0,8,14,2.0],[0,0,6,14,-1.0],[8,0,14,14,-1.0]]}]}"#])
}

#[cfg(feature = "networks")]
pub(crate) fn training_log() -> Vec<Vec<u8>> {
    let line = |step| {
        format!(
            r#"{{"step":{step},"seconds":1.5,"learning_rate":0.001,"samples_per_second":12.0,"losses":{{"total":0.5,"other":null}}}}"#
        )
    };
    texts(&[&format!("{}\n{}\n{}\n", line(10), line(20), line(30))])
}

#[cfg(feature = "networks")]
pub(crate) fn experience() -> Vec<Vec<u8>> {
    let camera = Camera::new(575.0, 575.0, 159.5, 119.5, 320, 240).expect("a camera");
    let inside = |x: usize, y: usize| (120..180).contains(&x) && (90..150).contains(&y);
    let depth = Image::from_fn(320, 240, |x, y| if inside(x, y) { 0.7 + 0.0003 * x as f32 } else { 0.0 });
    let mask = Mask::from_fn(320, 240, inside);
    let crop =
        Crop::new(&depth, &camera, &mask, &CropOptions::compact()).expect("a box in sight gives a crop");
    let experience = Experience {
        region: crop.mask.clone(),
        crop,
        camera_from_gripper: Pose::exp(&[0.0, 0.01, 0.7, 0.1, 3.0, 0.0].into()),
        opening: 0.07,
        width: 0.05,
        copies: vec![Copy { angle: 0.0, feature: vec![0.1; sixfold_experience::FEATURE] }],
        network: "seed".to_owned(),
        gripper: Gripper::built_in("jaws-85").expect("a built-in gripper"),
        object: "box".to_owned(),
        part: None,
        time: 1_700_000_000,
        provenance: "a seed".to_owned(),
    };
    let store = made("experience.db", |path| {
        let mut store = SqliteStore::create(path).expect("a store can be made");
        store.add(&experience).expect("the experience is one");
    });
    vec![store]
}
