//! Reads obstacles from masks: the NIfTI-1 images that `[goal]` names.

use super::output::print_stderr;
use crate::geometry::Pose;
use crate::plan::{Mask, Obstacle, World};
use crate::telemetry::open_regular;
use flate2::CrcReader;
use flate2::read::MultiGzDecoder;
use nalgebra::Vector3;
use nifti::{NiftiError, NiftiHeader, NiftiObject, RandomAccessNiftiVolume, ReaderOptions};
use std::fs::File;
use std::io::{self, Read};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

/// A reader of the masks that the configuration in `file` names. Their paths are relative to its folder. It reads
/// each mask once: the trials of a study share it. `warn` gets what the operator should know about it.
pub(super) fn mask_reader(
    file: Option<&Path>,
    warn: fn(&str),
) -> impl Fn(&str, Option<u32>, &Pose) -> Result<Obstacle, String> + Sync {
    let read = Mutex::new(Vec::new());
    move |name, crc32, pose| {
        let mut read = read.lock().unwrap_or_else(PoisonError::into_inner);
        let key = (name.to_owned(), crc32, *pose);
        if let Some((_, obstacle)) = read.iter().find(|(other, _)| *other == key) {
            return Ok(Obstacle::clone(obstacle));
        }
        let path = file.map_or_else(|| PathBuf::from(name), |file| file.with_file_name(name));
        let obstacle = read_mask(&path, crc32, pose, warn)
            .map_err(|error| format!("{}: {error}", path.display()))?;
        read.push((key, obstacle.clone()));
        Ok(obstacle)
    }
}

/// The image in `path`, as an obstacle.
fn read_mask(
    path: &Path,
    crc32: Option<u32>,
    pose: &Pose,
    warn: fn(&str),
) -> Result<Obstacle, String> {
    check_name(path, open_regular(path).map_err(|error| error.to_string())?)?;
    let header = NiftiHeader::from_file(path).map_err(|error| reason(&error))?;
    // A record has one checksum for a mask, so the mask must be one file.
    if &header.magic != b"n+1\0" {
        return Err("its voxels are in another file (.img); write both as one .nii".to_owned());
    }
    let dim = header.dim().map_err(|error| reason(&error))?;
    let size: [usize; 3] = match dim {
        [x, y, z, rest @ ..] if rest.iter().all(|count| *count == 1) => {
            [*x, *y, *z].map(usize::from)
        }
        _ => return Err(format!("the mask has {} dimensions, allowed: 3", dim.len())),
    };
    if let Some(count) = dim.iter().map(|count| count.cast_signed()).find(|count| *count < 0) {
        return Err(format!(
            "its header gives {count} voxels along an axis (dim); correct the header"
        ));
    }
    if !is_upright(&header) {
        return Err("its header turns or mirrors the voxels; resample it along x, y, z".to_owned());
    }
    check_voxel_size(&header)?;
    if !(header.scl_slope.is_finite() && header.scl_inter.is_finite()) {
        return Err(format!(
            "its header scales the voxels by {} and adds {} (scl_slope, scl_inter), allowed: finite numbers; correct \
             the header",
            header.scl_slope, header.scl_inter
        ));
    }
    check_data_type(&header)?;
    let [_, x, y, z, ..] = header.pixdim.map(f64::from);
    let spacing_mm = Vector3::new(x, y, z);
    let voxels = Mask::voxel_count(size, &spacing_mm)?;
    check_length(path, &header, voxels)?;
    let image = ReaderOptions::new().read_file(path).map_err(|error| reason(&error))?;
    // `nifti` reads the voxels from here on, whatever `vox_offset` says.
    let first_byte = HEADER_BYTES + image.extensions().bytes_on_disk();
    if f64::from(header.vox_offset) != first_byte as f64 {
        return Err(format!(
            "its voxels begin at byte {} by its header (vox_offset), allowed: {first_byte}, where the header \
             and its extensions end; load and save it, e.g. with nibabel",
            header.vox_offset
        ));
    }
    let image = image.into_volume();
    let mut index = vec![0; dim.len()];
    let occupied = (0..voxels).map(|voxel| {
        let [nx, ny, _] = size;
        let xyz = [voxel % nx, voxel / nx % ny, voxel / nx / ny];
        index.iter_mut().zip(xyz).for_each(|(index, i)| *index = i as u16);
        // NaN is not 0: an unknown voxel counts as part of the obstacle.
        image.get_f64(&index).map(|value| value != 0.0).map_err(|error| reason(&error))
    });
    let occupied: Vec<bool> = occupied.collect::<Result<_, _>>()?;
    let found = file_crc32(path).map_err(|error| error.to_string())?;
    if let Some(crc32) = crc32.filter(|crc32| *crc32 != found) {
        return Err(format!(
            "the content of the mask differs: its CRC-32 is {found:#010x}, crc32 says {crc32:#010x}; find \
             the file that was meant, or correct the key"
        ));
    }
    if !occupied.contains(&true) {
        return Err(
            "all of its voxels are 0, so it is no obstacle: is it the right label?".to_owned()
        );
    }
    if let Some(elsewhere) = elsewhere(&header, &pose.translation) {
        warn(&format!("{}: {elsewhere}", path.display()));
    }
    Mask::new(size, spacing_mm, &occupied, pose).map(Obstacle::Mask)
}

/// A warning that the header places the image elsewhere than `pose_mm`: the operator may have forgotten its origin.
fn elsewhere(header: &NiftiHeader, pose_mm: &Vector3<f64>) -> Option<String> {
    let origin_mm = match header {
        _ if header.sform_code > 0 => [header.srow_x[3], header.srow_y[3], header.srow_z[3]],
        _ if header.qform_code > 0 => [header.quatern_x, header.quatern_y, header.quatern_z],
        _ => return None,
    };
    let origin_mm = Vector3::from(origin_mm.map(f64::from));
    let differs = (origin_mm - pose_mm).norm() > ORIGIN_DIFFERENCE_MAX_MM;
    let place = |mm: &Vector3<f64>| format!("({:.2}, {:.2}, {:.2})", mm.x, mm.y, mm.z);
    (differs && origin_mm != Vector3::zeros()).then(|| {
        format!(
            "its header places voxel (0, 0, 0) at {} mm, pose at {}; the header's origin is not used",
            place(&origin_mm),
            place(pose_mm)
        )
    })
}

/// Warns of obstacles so far outside the workspace of `world` that no path comes near them.
pub(super) fn warn_of_far_obstacles(world: &World, clearance_mm: f64) {
    for (i, obstacle) in world.obstacles.iter().enumerate() {
        let outside_mm = world.workspace.outside_mm(obstacle);
        if outside_mm > clearance_mm {
            print_warning(&format!(
                "goal.obstacle[{i}] is {outside_mm:.1} mm outside goal.workspace_mm (goal.clearance_mm is \
                 {clearance_mm}), so it has no effect: is it in the plane's frame?"
            ));
        }
    }
}

/// Prints a warning to stderr.
pub(super) fn print_warning(text: &str) {
    print_stderr(format_args!("warning: {text}"));
}

/// Takes the warnings of a mask that another reader has warned of.
pub(super) fn no_warning(_: &str) {}

/// Origins that differ by more than this, mm, are two places.
const ORIGIN_DIFFERENCE_MAX_MM: f64 = 0.01;

/// The size of a NIfTI-1 header, and of the four bytes after it that say whether extensions follow.
const HEADER_BYTES: usize = 352;
/// Voxels begin at this byte at the latest.
const VOXEL_OFFSET_MAX: f64 = 1e6;

/// Refuses a compressed image whose name does not say so: `nifti` goes by the name.
fn check_name(path: &Path, mut file: File) -> Result<(), String> {
    let mut start = [0; 2];
    let is_read = file.read_exact(&mut start).is_ok();
    match is_read && start == [0x1f, 0x8b] && !is_compressed(path) {
        true => Err("it is compressed by gzip; give it a name that ends in .nii.gz".to_owned()),
        false => Ok(()),
    }
}

fn is_compressed(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension == "gz")
}

/// Refuses an image with bytes after its voxels: its header may belong to another image. A compressed image is
/// refused if its bytes are damaged.
fn check_length(path: &Path, header: &NiftiHeader, voxels: usize) -> Result<(), String> {
    let unreadable = |error: io::Error| reason(&NiftiError::Io(error));
    // `nifti` reads extensions into memory.
    if !(HEADER_BYTES as f64..=VOXEL_OFFSET_MAX).contains(&f64::from(header.vox_offset)) {
        return Err(format!(
            "its voxels begin at byte {} (vox_offset), allowed: {HEADER_BYTES} to {VOXEL_OFFSET_MAX}; remove its \
             extensions, or correct the header",
            header.vox_offset
        ));
    }
    let file = File::open(path).map_err(unreadable)?;
    let image: Box<dyn Read> =
        if is_compressed(path) { Box::new(MultiGzDecoder::new(file)) } else { Box::new(file) };
    let bits = u64::try_from(header.bitpix).unwrap_or_default() * voxels as u64;
    let expected = f64::from(header.vox_offset) as u64 + bits / 8;
    // Reads no further than needed: a compressed file may expand to any length.
    let length = io::copy(&mut image.take(expected + 1), &mut io::sink()).map_err(unreadable)?;
    match length > expected {
        true => Err(format!(
            "the file has more data than the {voxels} voxels in its header: was the image cropped without its \
             header, or is the header of another image?"
        )),
        false => Ok(()),
    }
}

/// The CRC-32 of the file in `path`, read in pieces: a file that is not a mask may be of any size.
pub(super) fn file_crc32(path: &Path) -> io::Result<u32> {
    let mut file = CrcReader::new(open_regular(path)?);
    io::copy(&mut file, &mut io::sink())?;
    Ok(file.crc().sum())
}

/// Why an image cannot be read.
fn reason(error: &NiftiError) -> String {
    match error {
        NiftiError::Io(error) if error.kind() == io::ErrorKind::UnexpectedEof => {
            "no NIfTI image, or the file is cut off; copy it again".to_owned()
        }
        NiftiError::IncompatibleLength(..) => {
            "the image is cut off: its header announces more voxels; copy it again".to_owned()
        }
        // Its own text is for developers: `Io(Custom { kind: …`.
        NiftiError::Io(error) => format!("no NIfTI image can be read: {error}; copy it again"),
        error => format!("no NIfTI image can be read: {error}"),
    }
}

/// The largest part of a voxel's side that may point along another axis.
const TILT_MAX: f32 = 1e-3;

/// True if the header neither turns nor mirrors the voxels, so that only the configured pose places them.
fn is_upright(header: &NiftiHeader) -> bool {
    let [qfac, sides @ ..] = header.pixdim;
    if header.sform_code > 0 {
        let rows = [header.srow_x, header.srow_y, header.srow_z];
        (0..3).all(|i| {
            (0..3).all(|j| match i == j {
                true => rows[i][j] > 0.0,
                false => rows[i][j].abs() <= TILT_MAX * sides[j].abs(),
            })
        })
    } else {
        // These are sines of half the angle: a side tilts by twice as much.
        let half_sines = [header.quatern_b, header.quatern_c, header.quatern_d];
        // NaN is not upright.
        let is_unturned = half_sines.iter().all(|sine| 2.0 * sine.abs() <= TILT_MAX);
        header.qform_code <= 0 || (qfac >= 0.0 && is_unturned)
    }
}

/// Refuses an image whose voxels may not be of the size `pixdim` in mm: an obstacle must not be taken for smaller
/// than it is.
fn check_voxel_size(header: &NiftiHeader) -> Result<(), String> {
    // NIfTI-1, xyzt_units: the lowest three bits are the unit of space.
    let unit = match header.xyzt_units & 7 {
        // No unit means mm, as in other programs.
        0 | 2 => None,
        1 => Some("metres".to_owned()),
        3 => Some("micrometres".to_owned()),
        code => Some(format!("units of code {code}")),
    };
    if let Some(unit) = unit {
        return Err(format!("its header gives lengths in {unit}, allowed: mm (xyzt_units)"));
    }
    let [_, x, y, z, ..] = header.pixdim;
    let rows = [header.srow_x[0], header.srow_y[1], header.srow_z[2]];
    let differ = |(row, side): (&f32, &f32)| (row - side).abs() > TILT_MAX * side.abs();
    if header.sform_code > 0 && rows.iter().zip(&[x, y, z]).any(differ) {
        let [a, b, c] = rows;
        return Err(format!(
            "its header gives voxels of two sizes, {x} x {y} x {z} mm (pixdim) and {a} x {b} x {c} mm \
             (srow); resample it, or correct the header"
        ));
    }
    Ok(())
}

/// Refuses an image whose `bitpix` contradicts its `datatype`: its length would be checked by one of them, and its
/// voxels read by the other.
fn check_data_type(header: &NiftiHeader) -> Result<(), String> {
    let data_type = header.data_type().map_err(|error| reason(&error))?;
    let (bitpix, bits) = (header.bitpix, 8 * data_type.size_of());
    match usize::try_from(bitpix) == Ok(bits) {
        true => Ok(()),
        false => Err(format!(
            "its header gives voxels of {bitpix} bits (bitpix) and of {bits} bits (datatype {}, {data_type:?}); \
             correct the header",
            header.datatype
        )),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A rotation by 1e-3 rad is allowed; the quaternion holds the sine of half of it.
    #[test]
    fn a_quaternion_tilts_a_voxel_by_twice_its_sine() {
        let is_upright_with = |quatern_d: f32| {
            is_upright(&NiftiHeader {
                sform_code: 0,
                qform_code: 1,
                quatern_d,
                ..NiftiHeader::default()
            })
        };
        assert!(is_upright_with(0.49e-3) && is_upright_with(-0.49e-3));
        assert!(!is_upright_with(0.51e-3) && !is_upright_with(-0.51e-3));
        assert!(!is_upright_with(f32::NAN));
    }

    /// The trials of a study share the masks that the configuration names.
    #[test]
    fn a_mask_is_read_once() {
        let mut image = vec![0; 352];
        let mut put = |at: usize, bytes: &[u8]| image[at..at + bytes.len()].copy_from_slice(bytes);
        put(0, &348i32.to_le_bytes());
        put(40, &[3u16, 2, 1, 1, 1, 1, 1, 1].map(u16::to_le_bytes).concat());
        put(70, &[2i16, 8].map(i16::to_le_bytes).concat());
        put(76, &[1f32; 4].map(f32::to_le_bytes).concat());
        put(108, &352f32.to_le_bytes());
        put(344, b"n+1\0");
        image.extend([0, 1]);
        let file = std::env::temp_dir().join(format!("needle-once-{}.nii", std::process::id()));
        std::fs::write(&file, image).expect("a mask");
        let (read, name) = (mask_reader(None, no_warning), file.to_str().expect("text"));
        let first = read(name, None, &Pose::identity()).expect("a mask");
        std::fs::remove_file(&file).expect("the mask");
        assert_eq!(read(name, None, &Pose::identity()), Ok(first));
        assert!(read(name, Some(1), &Pose::identity()).is_err(), "another checksum is expected");
    }

    #[test]
    fn a_device_or_pipe_in_place_of_a_mask_is_refused() {
        let pipe = std::env::temp_dir().join(format!("needle-mask-{}", std::process::id()));
        nix::unistd::mkfifo(&pipe, nix::sys::stat::Mode::S_IRUSR).expect("a pipe");
        for path in [Path::new("/dev/zero"), &pipe] {
            assert_eq!(file_crc32(path).unwrap_err().to_string(), "not a regular file");
            let read = mask_reader(None, no_warning)(
                path.to_str().expect("text"),
                None,
                &Pose::identity(),
            );
            let error = read.expect_err("it is refused");
            assert!(error.ends_with(": not a regular file"), "{error}");
        }
        std::fs::remove_file(&pipe).expect("the pipe");
    }
}
