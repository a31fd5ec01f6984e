//! Meshes, images, camera files, named objects.
//!
//! # Read and write a mesh
//!
//! Mesh files do not state their unit, so readers take it as an argument and refuse sizes that no tabletop
//! object has.
//!
//! ```
//! use sixfold::mesh::{PlyFormat, read_mesh, simplify, write_ply};
//! use sixfold::prelude::*;
//! use sixfold::synth::primitives::bottle;
//!
//! let folder = tempfile::tempdir()?;
//! let file = folder.path().join("bottle.ply");
//! let mesh = bottle(0.035, 0.2)?;
//! write_ply(&file, &mesh, Unit::Millimetre, PlyFormat::BinaryLittleEndian)?;
//! let read = read_mesh(&file, Unit::Millimetre)?;
//! assert!((read.diameter() - mesh.diameter()).abs() < 1e-6);
//! assert!(simplify(&read, 200).faces().len() <= 200);
//!
//! let error = read_mesh(&file, Unit::Metre).unwrap_err(); // a bottle of 200 metres
//! assert!(error.to_string().contains("mm"), "{error}");
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! # Images and camera files
//!
//! ```
//! use sixfold::io::{CameraFile, read_depth, write_atomically, write_depth};
//! use sixfold::prelude::*;
//!
//! let folder = tempfile::tempdir()?;
//! let (image, camera) = (folder.path().join("depth.png"), folder.path().join("camera.json"));
//! write_depth(&image, &DepthImage::filled(160, 120, 0.75), 0.001)?; // in whole millimetres
//! let depth = read_depth(&image, 0.001)?;
//! assert!((depth[(3, 4)] - 0.75).abs() < 1e-6);
//!
//! write_atomically(&camera, br#"{"fx": 300, "fy": 300, "cx": 79.5, "cy": 59.5}"#)?;
//! let camera = CameraFile::read(&camera)?.for_image(160, 120, &camera)?;
//! assert_eq!((camera.fx, camera.width), (300.0, 160));
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! # Objects under names
//!
//! Data that a method derives from an object is stored with the object.
//!
//! ```
//! use sixfold::estimator::{NewObject, ObjectRecord};
//! use sixfold::mesh::ModelInfo;
//! use sixfold::prelude::*;
//! use sixfold::synth::primitives::mug;
//!
//! let folder = tempfile::tempdir()?;
//! let store = ObjectStore::new(folder.path().join("objects"));
//! let mesh = mug(0.04, 0.10, 0.004, 0.03)?;
//! let info = ModelInfo::of_mesh(&mesh);
//! let record = ObjectRecord::of_mesh("mug.ply".as_ref(), Unit::Millimetre, &mesh, &info);
//! let new = NewObject { mesh: Some(&mesh), record: &record, replace: false };
//! let method = PpfEstimator::default();
//! store.add("mug", new, |object| Ok(method.prepare(object).map(|_| ())?))?;
//! assert_eq!(store.names()?, ["mug"]);
//! assert!(store.load("mug")?.file("ppf.bin").is_some_and(|f| f.is_file()));
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! # The cache
//!
//! A mesh file has no folder in a store, so its derived data is stored in a bounded cache, or not at all.
//!
//! ```
//! use sixfold::mesh::ModelInfo;
//! use sixfold::prelude::*;
//! use sixfold::synth::primitives::cup;
//!
//! let folder = tempfile::tempdir()?;
//! let cache = Cache::new(folder.path(), 10 << 20); // at most 10 MiB
//! let mesh = cup(0.04, 0.10, 0.004)?;
//! let info = ModelInfo::of_mesh(&mesh);
//! let folder = cache.of_mesh(&mesh, &info)?;
//! let object = Object { folder, ..Object::of_mesh("cup", mesh, info) };
//! PpfEstimator::default().prepare(&object)?;
//! assert!(object.file("ppf.bin").is_some_and(|f| f.is_file()));
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
