//! Tensors as slices.

use tch::{Device, Kind, Tensor};

/// The numbers of a contiguous 32-bit tensor on the host.
#[expect(unsafe_code, reason = "tch gives no view of a tensor's memory")]
pub(super) fn numbers(x: &Tensor) -> &[f32] {
    assert_dense(x);
    // SAFETY: the tensor is dense, so so many numbers lie there, and it lives as long as the slice. Nobody writes to
    // tensors that are shared: the kernels write to those only that they have made.
    unsafe { std::slice::from_raw_parts(x.data_ptr().cast::<f32>(), x.numel()) }
}

/// The numbers of a tensor that was just made, to be written.
#[expect(unsafe_code, reason = "tch gives no view of a tensor's memory")]
pub(super) fn numbers_mut(x: &mut Tensor) -> &mut [f32] {
    assert_dense(x);
    // SAFETY: as in `numbers`; the caller has made the tensor and shares it with nobody yet.
    unsafe { std::slice::from_raw_parts_mut(x.data_ptr().cast::<f32>(), x.numel()) }
}

/// A tensor for all of whose numbers something will be written.
pub(super) fn room(shape: &[i64]) -> Tensor {
    Tensor::empty(shape, (Kind::Float, Device::Cpu))
}

fn assert_dense(x: &Tensor) {
    assert!(x.is_contiguous() && x.kind() == Kind::Float && x.device() == Device::Cpu);
}
