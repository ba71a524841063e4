//! Saving and loading the parameters of a module in safetensors files. The tensors have the names of the parameters.

use super::{Dtype, bytes_of, read, read_numbers, replace};
use crate::error::FileError;
use crate::param::Module;
use crate::real::Real;
use crate::tensor::Tensor;
use safetensors::tensor::TensorView;
use safetensors::{SafeTensors, View};
use std::borrow::Cow;
use std::collections::BTreeMap;
use std::fs::File;
use std::path::Path;

/// Writes every parameter of a module to a safetensors file, under its name, with type F32 for `f32` and F64 for `f64`. Bounds and optimizer state are not
/// written.
///
/// ```
/// use autograd::nn::{Activation, Mlp};
/// use autograd::{load_safetensors, random::Stream, save_safetensors};
/// let path = std::env::temp_dir().join(format!("autograd-{}.safetensors", std::process::id()));
/// let trained = Mlp::<f32>::new("mlp", &[3, 8, 1], Activation::Relu, &Stream::new(1));
/// save_safetensors(&trained, &path)?;
///
/// let mut net = Mlp::<f32>::new("mlp", &[3, 8, 1], Activation::Relu, &Stream::new(2));
/// load_safetensors(&mut net, &path)?;
/// assert_eq!(net.layers[0].weight.tensor().data(), trained.layers[0].weight.tensor().data());
/// # std::fs::remove_file(path).unwrap();
/// # Ok::<(), autograd::FileError>(())
/// ```
///
/// Errors: [`FileError::Tensor`] if two parameters have the same name; [`FileError::Io`] if the file cannot be written, for example because the folder does not
/// exist.
pub fn save_safetensors<T: Real>(module: &dyn Module<T>, path: impl AsRef<Path>) -> Result<(), FileError> {
    let path = path.as_ref();
    let values = by_name(module, path)?;
    replace(path, |temporary| {
        // The safetensors crate creates files that only their owner can read. This restores the default permissions.
        let permissions = File::create(temporary)?.metadata()?.permissions();
        let views = values.iter().map(|(name, value)| (name, Stored(value)));
        safetensors::serialize_to_file(views, None, temporary).map_err(|e| match e {
            safetensors::SafeTensorError::IoError(e) => e,
            e => std::io::Error::other(e),
        })?;
        std::fs::set_permissions(temporary, permissions)
    })
}

/// Sets every parameter of a module to the tensor of its name in a safetensors file. F32 and F64 are converted to `T`. Parameters keep their identity and their
/// bounds. Weights of linear layers from PyTorch must be transposed before they are saved to the file.
///
/// Errors: [`FileError::Io`] if the file cannot be read; [`FileError::Format`] if it is not a safetensors file; [`FileError::Tensor`] if a parameter is missing
/// in the file or has another shape or another type there, if a tensor in the file is not a parameter, or if two parameters have the same name. On an error the
/// module is not changed.
pub fn load_safetensors<T: Real>(module: &mut dyn Module<T>, path: impl AsRef<Path>) -> Result<(), FileError> {
    let path = path.as_ref();
    let bytes = read(path)?;
    let file = SafeTensors::deserialize(&bytes).map_err(|e| FileError::Format {
        path: path.to_owned(),
        found: format!("not a complete safetensors file ({e})"),
        expected: "a safetensors file".into(),
    })?;
    let values = by_name(module, path)?;
    let refused = |tensor: &str, found: String, expected: String| FileError::Tensor {
        path: path.to_owned(),
        tensor: tensor.to_owned(),
        found,
        expected,
    };
    if let Some(name) = file.names().into_iter().filter(|name| !values.contains_key(*name)).min() {
        let known: Vec<&str> = values.keys().map(String::as_str).collect();
        return Err(refused(name, "a tensor that is not a parameter of the module".into(), format!("only {}", known.join(", "))));
    }
    for (name, value) in &values {
        let expected = || format!("F32 or F64 {:?}", value.shape());
        let Ok(stored) = file.tensor(name) else { return Err(refused(name, "no tensor with this name".into(), expected())) };
        if dtype_of(&stored).is_none() || stored.shape() != value.shape() {
            return Err(refused(name, format!("{:?} {:?}", stored.dtype(), stored.shape()), expected()));
        }
    }
    // `values` shares the buffers of the parameters. Dropping it lets the parameters be overwritten in place.
    drop(values);
    module.visit_mut(&mut |param| {
        let stored = file.tensor(param.name()).ok().and_then(|stored| Some((dtype_of(&stored)?, stored)));
        let (dtype, stored) = stored.expect("checked above");
        param.update(|values| read_numbers(stored.data(), dtype, values));
    });
    Ok(())
}

/// Returns the values of the parameters by name, or an error if two parameters have the same name.
fn by_name<T: Real>(module: &dyn Module<T>, path: &Path) -> Result<BTreeMap<String, Tensor<T>>, FileError> {
    let (mut values, mut twice) = (BTreeMap::new(), None);
    module.visit(&mut |param| {
        if values.insert(param.name().to_owned(), param.tensor().detach()).is_some() {
            twice.get_or_insert_with(|| param.name().to_owned());
        }
    });
    match twice {
        None => Ok(values),
        Some(tensor) => Err(FileError::Tensor {
            path: path.to_owned(),
            tensor,
            found: "two parameters with this name".into(),
            expected: "a unique name for each parameter of the module".into(),
        }),
    }
}

/// Returns the type of the numbers of a tensor, or `None` if the type is not supported.
fn dtype_of(stored: &TensorView<'_>) -> Option<Dtype> {
    match stored.dtype() {
        safetensors::Dtype::F32 => Some(Dtype::F32),
        safetensors::Dtype::F64 => Some(Dtype::F64),
        _ => None,
    }
}

/// A tensor that is converted to bytes when it is written.
struct Stored<'a, T: Real>(&'a Tensor<T>);

impl<T: Real> View for Stored<'_, T> {
    fn dtype(&self) -> safetensors::Dtype {
        match Dtype::of::<T>() {
            Dtype::F32 => safetensors::Dtype::F32,
            Dtype::F64 => safetensors::Dtype::F64,
        }
    }

    fn shape(&self) -> &[usize] {
        self.0.shape()
    }

    fn data(&self) -> Cow<'_, [u8]> {
        Cow::Owned(bytes_of(self.0.data()))
    }

    fn data_len(&self) -> usize {
        self.0.len() * Dtype::of::<T>().size()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::param::Param;
    use ndarray::{Array1, Array2};
    use std::path::PathBuf;

    /// A temporary folder, which is removed when this value is dropped.
    struct Place(PathBuf);

    impl Place {
        fn new(name: &str) -> Self {
            let folder = std::env::temp_dir().join(format!("autograd-{}-{name}", std::process::id()));
            std::fs::create_dir_all(&folder).expect("a folder for temporary files");
            Place(folder)
        }

        fn file(&self) -> PathBuf {
            self.0.join("module.safetensors")
        }
    }

    impl Drop for Place {
        fn drop(&mut self) {
            let _ = std::fs::remove_dir_all(&self.0);
        }
    }

    fn module<T: Real>(value: f64) -> Vec<Param<T>> {
        let table = Array2::from_shape_fn((2, 3), |(r, c)| T::lit(value + (3 * r + c) as f64 / 7.0));
        vec![Param::new("table", table), Param::new("offset", Array1::from_elem(4, T::lit(value)))]
    }

    #[test]
    fn values_come_back_in_place_and_in_either_precision() {
        let place = Place::new("back");
        save_safetensors(&module::<f64>(1.0), place.file()).expect("a file");
        let mut loaded = module::<f64>(0.0);
        let before = loaded.iter().map(|param| (param.id(), param.tensor().data().as_ptr())).collect::<Vec<_>>();
        load_safetensors(&mut loaded, place.file()).expect("the file");
        assert_eq!(loaded.iter().map(|param| (param.id(), param.tensor().data().as_ptr())).collect::<Vec<_>>(), before);
        assert!(loaded.iter().zip(module::<f64>(1.0)).all(|(a, b)| a.tensor().data() == b.tensor().data()));
        let mut single = module::<f32>(0.0);
        load_safetensors(&mut single, place.file()).expect("the file");
        assert_eq!(single[0].tensor().data(), module::<f32>(1.0)[0].tensor().data());
        save_safetensors(&single, place.file()).expect("a file in place of the other");
        load_safetensors(&mut loaded, place.file()).expect("the file");
        assert_eq!(loaded[0].tensor().data()[1], f64::from((1.0f64 + 1.0 / 7.0) as f32));
        assert_eq!(std::fs::read_dir(&place.0).expect("the folder").count(), 1, "a temporary file is left");
    }

    #[test]
    fn what_does_not_fit_is_refused_by_file_and_tensor_and_changes_nothing() {
        let place = Place::new("refused");
        let mut net = module::<f32>(0.0);
        let mut refusal = |parts: &[&str]| {
            let error = load_safetensors(&mut net, place.file()).expect_err("a misfit").to_string();
            for part in parts.iter().chain(&["module.safetensors"]) {
                assert!(error.contains(part), "{part} is not in: {error}");
            }
            assert!(net.iter().zip(module::<f32>(0.0)).all(|(a, b)| a.tensor().data() == b.tensor().data()));
        };
        refusal(&["reading"]);
        std::fs::write(place.file(), b"no tensors").expect("a file");
        refusal(&["not a complete safetensors file"]);
        let mut other = module::<f32>(1.0);
        other.pop();
        save_safetensors(&other, place.file()).expect("a file");
        refusal(&["`offset`", "no tensor with this name", "[4]"]);
        other.push(Param::new("offset", Array1::zeros(5)));
        save_safetensors(&other, place.file()).expect("a file");
        refusal(&["`offset`", "F32 [5]", "F32 or F64 [4]"]);
        other[1] = Param::new("offset", Array1::zeros(4));
        other.push(Param::new("more", Array1::zeros(4)));
        save_safetensors(&other, place.file()).expect("a file");
        refusal(&["`more`", "not a parameter", "offset, table"]);
        let halves = TensorView::new(safetensors::Dtype::F16, vec![4], &[0; 8]).expect("four halves");
        std::fs::write(place.file(), safetensors::serialize([("offset", halves)], None).expect("bytes")).expect("a file");
        refusal(&["`offset`", "F16 [4]", "F32 or F64 [4]"]);
    }

    #[test]
    fn a_name_that_occurs_twice_is_refused() {
        let place = Place::new("twice");
        let twice = (module::<f32>(0.0), module::<f32>(1.0));
        let error = save_safetensors(&twice, place.file()).expect_err("two of each").to_string();
        assert!(error.contains("`table`") && error.contains("two parameters"), "{error}");
        assert!(!place.file().exists());
    }
}
