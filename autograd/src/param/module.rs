//! [`Module`]: a set of parameters, and its implementations for collections and structs.

use crate::param::Param;
use crate::real::Real;

/// A set of parameters. The trait is implemented for [`Param`], for layers and networks, and for tuples (of two to six), arrays, vectors, options and
/// boxes of modules. [`impl_module!`](crate::impl_module) implements it for a struct.
///
/// ```
/// use autograd::{Module, nn::Linear, random::Stream};
/// let random = Stream::new(7);
/// let heads = (Linear::<f32>::new("density", 8, 1, &random), vec![Linear::new("color", 8, 3, &random)]);
/// assert_eq!(heads.param_count(), 8 + 1 + 24 + 3);
/// assert_eq!(heads.param_names(), ["density.weight", "density.bias", "color.weight", "color.bias"]);
/// assert!(heads.is_finite());
/// ```
pub trait Module<T: Real> {
    /// Visits every parameter, always in the same order.
    fn visit(&self, f: &mut dyn FnMut(&Param<T>));

    /// Visits every parameter mutably, in the same order as [`Module::visit`].
    fn visit_mut(&mut self, f: &mut dyn FnMut(&mut Param<T>));

    /// Returns the total number of elements of all parameters.
    fn param_count(&self) -> usize {
        let mut count = 0;
        self.visit(&mut |param| count += param.tensor().len());
        count
    }

    /// Returns the names of the parameters, in the order of [`Module::visit`].
    fn param_names(&self) -> Vec<String> {
        let mut names = Vec::new();
        self.visit(&mut |param| names.push(param.name().to_owned()));
        names
    }

    /// Returns true if no parameter contains an infinity or NaN.
    fn is_finite(&self) -> bool {
        let mut finite = true;
        self.visit(&mut |param| finite &= param.tensor().data().iter().all(|x| x.is_finite()));
        finite
    }
}

impl<T: Real> Module<T> for Param<T> {
    fn visit(&self, f: &mut dyn FnMut(&Param<T>)) {
        f(self);
    }

    fn visit_mut(&mut self, f: &mut dyn FnMut(&mut Param<T>)) {
        f(self);
    }
}

/// Implements [`Module`] for types with `iter` and `iter_mut`; the elements are visited in the order of the iterator.
macro_rules! collections {
    ($([$($generics:tt)*] $t:ty;)*) => {$(
        impl<T: Real, $($generics)*> Module<T> for $t {
            fn visit(&self, f: &mut dyn FnMut(&Param<T>)) {
                self.iter().for_each(|module| module.visit(f));
            }

            fn visit_mut(&mut self, f: &mut dyn FnMut(&mut Param<T>)) {
                self.iter_mut().for_each(|module| module.visit_mut(f));
            }
        }
    )*};
}
collections! {
    [M: Module<T>] Vec<M>;
    [M: Module<T>] Option<M>;
    [M: Module<T>, const N: usize] [M; N];
}

impl<T: Real, M: Module<T> + ?Sized> Module<T> for Box<M> {
    fn visit(&self, f: &mut dyn FnMut(&Param<T>)) {
        (**self).visit(f);
    }

    fn visit_mut(&mut self, f: &mut dyn FnMut(&mut Param<T>)) {
        (**self).visit_mut(f);
    }
}

macro_rules! tuples {
    ($($($m:ident $i:tt)+;)*) => {$(
        impl<T: Real, $($m: Module<T>),+> Module<T> for ($($m,)+) {
            fn visit(&self, f: &mut dyn FnMut(&Param<T>)) {
                $(self.$i.visit(f);)+
            }

            fn visit_mut(&mut self, f: &mut dyn FnMut(&mut Param<T>)) {
                $(self.$i.visit_mut(f);)+
            }
        }
    )*};
}
tuples! {
    A 0 B 1;
    A 0 B 1 C 2;
    A 0 B 1 C 2 D 3;
    A 0 B 1 C 2 D 3 E 4;
    A 0 B 1 C 2 D 3 E 4 F 5;
}

/// Implements [`Module`](crate::Module) for a struct that is generic over one scalar type, `T: Real`. The listed fields must be modules and are visited in
/// the listed order. Fields that are not listed are not parameters.
///
/// ```
/// use autograd::{Module, Param, Real, impl_module, nn::{Activation, Mlp}, random::Stream};
///
/// struct Field<T: Real> {
///     density: Param<T>,
///     color: Mlp<T>,
///     side: f64,
/// }
/// impl_module!(Field { density, color });
///
/// let field = Field::<f32> {
///     density: Param::new("density", ndarray::Array2::zeros((1000, 1))),
///     color: Mlp::new("color", &[6, 16, 3], Activation::Relu, &Stream::new(7)),
///     side: 2.0,
/// };
/// assert_eq!(field.param_count(), 1000 + 6 * 16 + 16 + 16 * 3 + 3);
/// assert_eq!(field.param_names()[..2], ["density", "color.0.weight"]);
/// # assert_eq!(field.side, 2.0);
/// ```
#[macro_export]
macro_rules! impl_module {
    ($name:ident { $($field:ident),+ $(,)? }) => {
        impl<T: $crate::Real> $crate::Module<T> for $name<T> {
            fn visit(&self, f: &mut dyn FnMut(&$crate::Param<T>)) {
                $($crate::Module::<T>::visit(&self.$field, f);)+
            }

            fn visit_mut(&mut self, f: &mut dyn FnMut(&mut $crate::Param<T>)) {
                $($crate::Module::<T>::visit_mut(&mut self.$field, f);)+
            }
        }
    };
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::arr1;

    fn param(name: &str, value: f64) -> Param<f64> {
        Param::new(name, arr1(&[value, 1.0]))
    }

    #[test]
    fn every_kind_of_module_visits_its_parts_in_order_and_changes_them_alike() {
        type Part = Box<dyn Module<f64>>;
        let mut module = (
            param("a", 0.0),
            [param("b", 0.0), param("c", 0.0)],
            vec![Box::new(param("d", 0.0)) as Part, Box::new((param("e", 0.0), param("f", 0.0)))],
            None::<Param<f64>>,
            Some(param("g", 0.0)),
        );
        let names = ["a", "b", "c", "d", "e", "f", "g"];
        assert_eq!(module.param_names(), names);
        assert_eq!(module.param_count(), 14);
        let mut visited = Vec::new();
        module.visit_mut(&mut |param| {
            visited.push(param.name().to_owned());
            param.update(|values| values[0] = 3.0);
        });
        assert_eq!(visited, names);
        module.visit(&mut |param| assert_eq!(param.tensor().data(), [3.0, 1.0]));
    }

    #[test]
    fn one_number_that_is_not_finite_is_seen() {
        assert!((param("a", 1.0), param("b", -1e300)).is_finite());
        assert!(!(param("a", 1.0), param("b", f64::NAN)).is_finite());
        assert!(!vec![param("a", f64::NEG_INFINITY)].is_finite());
    }
}
