//! The sample sequence that comes with the program: a ball of fire that turns to smoke, simulated with Mantaflow
//! in Blender. How it is drawn is decided in [`demo`](crate::demo).

/// The .vdb files of all frames, in order. Grids density, flame and temperature; z is up.
pub(crate) const BLAST: [&[u8]; 16] = [
    include_bytes!("../../../assets/blast/blast.0001.vdb"),
    include_bytes!("../../../assets/blast/blast.0002.vdb"),
    include_bytes!("../../../assets/blast/blast.0003.vdb"),
    include_bytes!("../../../assets/blast/blast.0004.vdb"),
    include_bytes!("../../../assets/blast/blast.0005.vdb"),
    include_bytes!("../../../assets/blast/blast.0006.vdb"),
    include_bytes!("../../../assets/blast/blast.0007.vdb"),
    include_bytes!("../../../assets/blast/blast.0008.vdb"),
    include_bytes!("../../../assets/blast/blast.0009.vdb"),
    include_bytes!("../../../assets/blast/blast.0010.vdb"),
    include_bytes!("../../../assets/blast/blast.0011.vdb"),
    include_bytes!("../../../assets/blast/blast.0012.vdb"),
    include_bytes!("../../../assets/blast/blast.0013.vdb"),
    include_bytes!("../../../assets/blast/blast.0014.vdb"),
    include_bytes!("../../../assets/blast/blast.0015.vdb"),
    include_bytes!("../../../assets/blast/blast.0016.vdb"),
];
