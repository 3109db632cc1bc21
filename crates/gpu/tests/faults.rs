//! What happens when a device is lost, memory runs out, or something is larger than a device takes: errors that say so, on
//! devices of our own and of a host, and never a panic.

mod common;

use common::{SIZE, cloud, gpu, host, lit};
use nuage_gpu::arrays::Arrays;
use nuage_gpu::device::Gpu;
use nuage_gpu::error::GpuError;
use nuage_gpu::look::{Look, Pass};
use nuage_gpu::renderer::Renderer;
use nuage_gpu::upload::Volume;
use nuage_render::views::View;

#[test]
fn a_lost_device_is_an_error() {
    for (whose, gpu) in [("ours", gpu()), ("a host's", host(wgpu::Limits::default()))] {
        let Some(gpu) = gpu else { return };
        let channel = cloud();
        let arrays = Arrays::of_channels(&[&channel]).expect("arrays");
        let volume = Volume::new(&gpu, &arrays).expect("a volume");
        let look = Look::of_scene(&lit(&channel)).expect("a look");
        let mut renderer = common::renderer(&gpu);
        renderer.prepare(&volume, &look, &Pass::View(View::Depth), 0, None).expect("a pass");
        renderer.run(&volume).expect("a run");
        gpu.device().destroy();
        assert_eq!(renderer.run(&volume), Err(GpuError::Lost), "{whose}");
        // From then on all of it says so, or does nothing.
        assert_eq!(renderer.pixels().map(drop), Err(GpuError::Lost), "{whose}");
        assert_eq!(gpu.wait(), Err(GpuError::Lost), "{whose}");
        assert_eq!(Volume::new(&gpu, &arrays).map(drop), Err(GpuError::Lost), "{whose}");
        let nothing = renderer.prepare(&volume, &look, &Pass::Hits { above: 0.0 }, 0, None);
        assert!(matches!(nothing, Ok(()) | Err(GpuError::Lost)), "{whose}: {nothing:?}");
        let nothing = Renderer::new(&gpu, [8, 8]).map(drop);
        assert!(matches!(nothing, Ok(()) | Err(GpuError::Lost)), "{whose}: {nothing:?}");
    }
}

/// Bricks in as many buffers as it takes, as if they were in one; and what is beyond that is refused.
#[test]
fn volumes_are_cut_where_bindings_end() {
    let Some(whole) = gpu() else { return };
    let channel = cloud();
    let arrays = Arrays::of_channels(&[&channel]).expect("arrays");
    let [_, bricks] = arrays.size_bytes();
    let look = Look::of_scene(&lit(&channel)).expect("a look");
    let pass = Pass::View(View::Density { extinction: 3.0 });
    let show = |gpu: &Gpu| {
        let volume = Volume::new(gpu, &arrays)?;
        assert_eq!(volume.size_bytes().bricks, bricks as u64);
        Ok::<_, GpuError>(common::picture(&mut common::renderer(gpu), &volume, &look, &pass, 0))
    };
    let picture = show(&whole).expect("a picture");
    let with = |bytes: u64| {
        host(wgpu::Limits { max_storage_buffer_binding_size: bytes, ..Default::default() }).expect("a device")
    };
    let binding = (bricks as u64).next_power_of_two() / 4;
    assert!(binding > 16 * u64::from(SIZE[0] * SIZE[1]), "the picture fits");
    assert_eq!(show(&with(binding)).expect("a picture"), picture);
    let refused = show(&with(1 << 16));
    assert!(matches!(refused, Err(GpuError::Limit { what: "the bricks of a volume", .. })), "{refused:?}");
    let refused = show(&with(1 << 10));
    assert!(matches!(refused, Err(GpuError::Limit { what: "a tree", .. })), "{refused:?}");
    let refused = Renderer::new(&with(1 << 16), SIZE).map(drop);
    assert!(matches!(refused, Err(GpuError::Limit { what: "a picture", .. })), "{refused:?}");
}
