//! What is asked of a source: no more than is needed, and its failures reach the caller.

mod surgery;

use std::borrow::Cow;
use std::io;
use std::ops::Range;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

use nuage_testkit as testkit;
use nuage_vdb::{Error, File, Source};

fn committed(name: &str) -> Vec<u8> {
    std::fs::read(testkit::committed("data/edge").join(name)).unwrap()
}

/// Copies out what is asked for, as a file on a disk would, and notes it.
struct Recorder {
    bytes: Vec<u8>,
    asked: Mutex<Vec<Range<usize>>>,
}

impl Source for Recorder {
    fn size_bytes(&self) -> io::Result<u64> {
        Ok(self.bytes.len() as u64)
    }

    fn range(&self, offset: u64, len: usize) -> io::Result<Cow<'_, [u8]>> {
        let start = usize::try_from(offset).unwrap();
        self.asked.lock().unwrap().push(start..start + len);
        assert!(start + len <= self.bytes.len(), "asked past the end");
        Ok(Cow::Owned(self.bytes[start..start + len].to_vec()))
    }
}

#[test]
fn a_grid_is_read_without_touching_another() {
    let bytes = committed("transforms.vdb");
    let layout = surgery::layout(&bytes);
    let recorder = Recorder { bytes: bytes.clone(), asked: Mutex::default() };
    let (lent, copied) = (File::open(&bytes[..]).unwrap(), File::open(&recorder).unwrap());

    const HEADER_WINDOW_BYTES: usize = 64 << 10;
    let windows = std::mem::take(&mut *recorder.asked.lock().unwrap());
    assert!(windows.len() <= 1 + 2 * layout.grids.len(), "{windows:?}");
    assert!(windows.iter().all(|window| window.len() <= HEADER_WINDOW_BYTES), "{windows:?}");
    // Each window begins at a header.
    let mut headers: Vec<usize> = layout.grids.iter().flat_map(|g| [g.descriptor_at, g.begin]).collect();
    headers.push(0);
    assert!(windows.iter().all(|window| headers.contains(&window.start)), "{windows:?}");

    assert!(layout.grids.len() > 5 && copied.grids.len() == layout.grids.len());
    for (index, place) in layout.grids.iter().enumerate().rev() {
        let grid = copied.read_grid(index).unwrap();
        let asked = std::mem::take(&mut *recorder.asked.lock().unwrap());
        assert!(!asked.is_empty());
        for range in asked {
            assert!(place.begin <= range.start && range.end <= place.end, "grid {index} asked for {range:?}");
        }
        assert_eq!(grid.tree, lent.read_grid(index).unwrap().tree);
    }
}

/// Fails from the n-th call on.
struct Failing {
    bytes: Vec<u8>,
    calls_left: AtomicUsize,
}

impl Failing {
    fn call(&self) -> io::Result<()> {
        let left = self.calls_left.load(Ordering::Relaxed);
        self.calls_left.store(left.saturating_sub(1), Ordering::Relaxed);
        if left == 0 { Err(io::Error::new(io::ErrorKind::PermissionDenied, "taken away")) } else { Ok(()) }
    }
}

impl Source for Failing {
    fn size_bytes(&self) -> io::Result<u64> {
        self.call()?;
        self.bytes.as_slice().size_bytes()
    }

    fn range(&self, offset: u64, len: usize) -> io::Result<Cow<'_, [u8]>> {
        self.call()?;
        self.bytes.as_slice().range(offset, len)
    }
}

#[test]
fn a_failing_source_is_an_io_error() {
    let sound = committed("background_nonzero.vdb");
    for bytes in [surgery::as_stream(&sound), sound] {
        let mut calls = 0;
        loop {
            let source = Failing { bytes: bytes.clone(), calls_left: AtomicUsize::new(calls) };
            match File::open(source).and_then(|file| file.read_grid(1)) {
                Ok(_) => break,
                Err(Error::Io(error)) => assert_eq!(error.kind(), io::ErrorKind::PermissionDenied),
                Err(other) => panic!("after {calls} calls: {other:?}"),
            }
            calls += 1;
        }
        assert!(calls > 3, "only {calls} calls");
    }
}

/// Says another size each time, as a file does while it is written.
struct Growing {
    bytes: Vec<u8>,
    sizes: Mutex<Vec<u64>>,
}

impl Source for Growing {
    fn size_bytes(&self) -> io::Result<u64> {
        let mut sizes = self.sizes.lock().unwrap();
        Ok(if sizes.len() > 1 { sizes.remove(0) } else { sizes[0] })
    }

    fn range(&self, offset: u64, len: usize) -> io::Result<Cow<'_, [u8]>> {
        self.bytes.as_slice().range(offset, len)
    }
}

#[test]
fn a_file_that_changes_its_size_is_an_error() {
    let sound = committed("background_nonzero.vdb");
    for bytes in [surgery::as_stream(&sound), sound] {
        let whole = bytes.len() as u64;
        // Grown while it is opened, and cut short while it is opened.
        for sizes in [vec![60, whole], vec![whole + 1000]] {
            let source = Growing { bytes: bytes.clone(), sizes: Mutex::new(sizes.clone()) };
            let result = File::open(source).and_then(|file| file.read_grid(1)).map(|grid| grid.tree);
            assert!(matches!(result, Err(Error::Io(_) | Error::Malformed { .. })), "{sizes:?}: {result:?}");
        }
    }
}
