// Reference and CPU: the kernels as C++, which Python has compiled to a library; a thread is a work-group of one item.
#include "program_integrator.h"
#include "openmm/KernelFactory.h"
#include "openmm/Platform.h"
#include "openmm/System.h"
#include "openmm/internal/ThreadPool.h"
#include "openmm/reference/ReferencePlatform.h"
#include <dlfcn.h>
using namespace OpenMM;
using namespace std;

namespace kcons {

// Where kernels find pointers, see `kernels.py`.
typedef void (*PlainKernel)(void** pointers, const void* numbers, int group, int groups);

class PlainStep : public StepKernel {
public:
    PlainStep(const string& name, const Platform& platform, ReferencePlatform::PlatformData& data) : StepKernel(name, platform), data(data) {}
    ~PlainStep() { if (library != nullptr) dlclose(library); }
    void begin(ContextImpl& c, const vector<int>&) override {
        const System& system = c.getSystem();
        for (int k = 0; k < system.getNumParticles(); k++)
            inverse.push_back(system.getParticleMass(k) == 0 ? 0 : 1/system.getParticleMass(k));
        parallel = getPlatform().getName() == "CPU";
    }
    double kineticEnergy() override {
        double sum = 0;
        for (size_t k = 0; k < inverse.size(); k++) if (inverse[k] != 0) sum += (*data.velocities)[k].dot((*data.velocities)[k])/inverse[k];
        return sum/2;
    }
    vector<double> read(const string& name) override {
        if (!declared(name).whole) return reals[name];
        return vector<double>(integers[name].begin(), integers[name].end());
    }
    void write(const string& name, const vector<double>& values) override {
        if (declared(name, values.size()).whole) copy(values.begin(), values.end(), integers[name].begin());
        else copy(values.begin(), values.end(), reals[name].begin());
    }
protected:
    void prepare(ContextImpl& c) override {
        forces.resize(plan.slots);
        for (auto& array : plan.arrays) {
            if (array.whole) integers[array.name].assign(array.values.begin(), array.values.end());
            else reals[array.name] = array.values;
            own.push_back(array.whole ? (void*) integers[array.name].data() : (void*) reals[array.name].data());
        }
        library = dlopen(plan.library.c_str(), RTLD_NOW | RTLD_LOCAL);
        if (library == nullptr) throw OpenMMException(string("kcons: ")+dlerror());
    }
    void launch(const string& kernel) override {
        PlainKernel& code = kernels[kernel];
        if (code == nullptr) code = (PlainKernel) dlsym(library, kernel.c_str());
        if (code == nullptr) throw OpenMMException("kcons: no kernel is called '"+kernel+"'");
        vector<void*> pointers = {data.positions->data(), data.velocities->data(), inverse.data()};
        for (int slot = 0; slot < plan.slots; slot++)
            pointers.push_back(plan.slots == 1 ? data.forces->data() : forces[slot].data());
        pointers.insert(pointers.end(), own.begin(), own.end());
        const Numbers given = numbers;
        numbers.launch++;
        // A sum of few shares does not depend on the number of threads more than one of many.
        int groups = parallel && kernel != "look" ? min(data.threads.getNumThreads(), 256) : 1;
        if (groups == 1) { code(pointers.data(), &given, 0, 1); return; }
        data.threads.execute([&](ThreadPool&, int thread) { if (thread < groups) code(pointers.data(), &given, thread, groups); });
        data.threads.waitForThreads();
    }
    void keepForces(int slot) override { forces[slot] = *data.forces; }
private:
    ReferencePlatform::PlatformData& data;
    void* library = nullptr;
    bool parallel = false;
    map<string, PlainKernel> kernels;
    map<string, vector<double>> reals;
    map<string, vector<int>> integers;
    vector<void*> own;             // where these are, in the order of the plan
    vector<double> inverse;
    vector<vector<Vec3>> forces;
};

class PlainFactory : public KernelFactory {
    KernelImpl* createKernelImpl(string name, const Platform& platform, ContextImpl& c) const override {
        return new PlainStep(name, platform, *static_cast<ReferencePlatform::PlatformData*>(c.getPlatformData()));
    }
};

static const bool plainRegistered = [] {
    for (int k = 0; k < Platform::getNumPlatforms(); k++) {
        Platform& platform = Platform::getPlatform(k);
        if (platform.getName() == "Reference" || platform.getName() == "CPU")
            platform.registerKernelFactory(StepKernel::Name(), new PlainFactory());
    }
    return true;
}();

}
