//! Named arrays in a safetensors file, written atomically.

use std::{collections::HashMap, io::Write as _, path::Path};

use bytemuck::Pod;
use flyrig_types::write_whole;
use safetensors::{Dtype, SafeTensors, tensor::TensorView};

use crate::StfaError;

/// Number type that such a file can hold.
pub(crate) trait Number: Pod {
    const DTYPE: Dtype;
}

impl Number for f32 {
    const DTYPE: Dtype = Dtype::F32;
}

impl Number for u32 {
    const DTYPE: Dtype = Dtype::U32;
}

impl Number for u8 {
    const DTYPE: Dtype = Dtype::U8;
}

/// Collection of arrays to write.
#[derive(Debug, Default)]
pub(crate) struct TensorFile {
    arrays: Vec<(String, Dtype, Vec<usize>, Vec<u8>)>,
}

impl TensorFile {
    pub(crate) fn push<T: Number>(&mut self, name: impl Into<String>, shape: Vec<usize>, values: &[T]) {
        self.arrays.push((name.into(), T::DTYPE, shape, bytemuck::cast_slice(values).to_vec()));
    }

    pub(crate) fn to_bytes(&self, metadata: HashMap<String, String>) -> Result<Vec<u8>, String> {
        let views: Vec<(&str, TensorView<'_>)> = self
            .arrays
            .iter()
            .map(|(name, dtype, shape, bytes)| Ok((name.as_str(), TensorView::new(*dtype, shape.clone(), bytes)?)))
            .collect::<Result<_, safetensors::SafeTensorError>>()
            .map_err(|error| error.to_string())?;
        safetensors::serialize(views, Some(metadata)).map_err(|error| error.to_string())
    }

    pub(crate) fn write(&self, path: &Path, metadata: HashMap<String, String>) -> Result<(), StfaError> {
        let file = |source| StfaError::File { path: path.to_owned(), source };
        let bytes = self.to_bytes(metadata).map_err(|error| file(std::io::Error::other(error)))?;
        write_whole(path, |out| out.write_all(&bytes)).map_err(file)
    }
}

/// Reads the numbers of an array, which must have this shape.
pub(crate) fn array<T: Number>(file: &SafeTensors<'_>, name: &str, shape: &[usize]) -> Result<Vec<T>, String> {
    let found = view::<T>(file, name)?;
    if found.shape() != shape {
        return Err(format!("{name} has shape {:?}, expected {shape:?}", found.shape()));
    }
    Ok(bytemuck::pod_collect_to_vec(found.data()))
}

/// Reads rows of `N` numbers each.
pub(crate) fn rows<T: Number, const N: usize>(file: &SafeTensors<'_>, name: &str) -> Result<Vec<[T; N]>, String>
where
    [T; N]: Pod,
{
    let found = view::<T>(file, name)?;
    match found.shape() {
        [_, columns] if *columns == N => Ok(bytemuck::pod_collect_to_vec(found.data())),
        shape => Err(format!("{name} has shape {shape:?}, expected [any, {N}]")),
    }
}

fn view<'a, T: Number>(file: &SafeTensors<'a>, name: &str) -> Result<TensorView<'a>, String> {
    let found = file.tensor(name).map_err(|_| format!("{name} is missing"))?;
    if found.dtype() != T::DTYPE {
        return Err(format!("{name} holds {:?}, expected {:?}", found.dtype(), T::DTYPE));
    }
    Ok(found)
}

/// Reads a file's bytes.
pub(crate) fn read(path: &Path) -> Result<Vec<u8>, StfaError> {
    std::fs::read(path).map_err(|source| StfaError::File { path: path.to_owned(), source })
}
