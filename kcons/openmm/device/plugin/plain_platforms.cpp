// Reference and CPU: the kernels as C++, which Python has compiled to a library; a thread is a work-group of one item.
#include "steps.h"
#include "openmm/Platform.h"
#include "openmm/internal/ThreadPool.h"
#include "openmm/reference/ReferencePlatform.h"
#include <dlfcn.h>

namespace kcons {

// Where kernels find pointers, see `kernels.py`.
typedef void (*PlainKernel)(void** pointers, const void* numbers, int group, int groups);

class PlainSteps : public Steps {
public:
    PlainSteps(ContextImpl& c, bool parallel)
            : data(*static_cast<ReferencePlatform::PlatformData*>(c.getPlatformData())), parallel(parallel) {}
    ~PlainSteps() { if (library != nullptr) dlclose(library); }
    vector<double> read(const string& name) override {
        if (!declared(name).whole) return reals[name];
        return vector<double>(integers[name].begin(), integers[name].end());
    }
    void write(const string& name, const vector<double>& values) override {
        if (declared(name, values.size()).whole) copy(values.begin(), values.end(), integers[name].begin());
        else copy(values.begin(), values.end(), reals[name].begin());
    }
    void prepare(ContextImpl& c) override {
        for (double mass : given["masses"]) inverse.push_back(mass == 0 ? 0 : 1/mass);
        forces.resize(slots);
        for (auto& array : arrays) {
            if (array.whole) integers[array.name].assign(array.values.begin(), array.values.end());
            else reals[array.name] = array.values;
            if (array.passed) own.push_back(array.whole ? (void*) integers[array.name].data() : (void*) reals[array.name].data());
        }
        library = dlopen(Steps::library.c_str(), RTLD_NOW | RTLD_LOCAL);
        if (library == nullptr) throw OpenMMException(string("kcons: ")+dlerror());
    }
    void launch(const string& kernel) override {
        PlainKernel& code = kernels[kernel];
        if (code == nullptr) code = (PlainKernel) dlsym(library, kernel.c_str());
        vector<void*> pointers = {data.positions->data(), data.velocities->data(), inverse.data()};
        for (auto& kept : forces) pointers.push_back(slots == 1 ? data.forces->data() : kept.data());
        pointers.insert(pointers.end(), own.begin(), own.end());
        const Numbers given = numbers;
        numbers.launch++;
        // A sum of few shares does not depend on the number of threads more than one of many.
        int groups = parallel && kernel != "look" ? min(data.threads.getNumThreads(), 256) : 1;
        if (groups == 1) { code(pointers.data(), &given, 0, 1); return; }
        data.threads.execute([&](ThreadPool&, int thread) { if (thread < groups) code(pointers.data(), &given, thread, groups); });
        data.threads.waitForThreads();
    }
protected:
    void keepForces(int slot) override { forces[slot] = *data.forces; }
private:
    ReferencePlatform::PlatformData& data;
    const bool parallel;
    void* library = nullptr;
    map<string, PlainKernel> kernels;
    map<string, vector<double>> reals;
    map<string, vector<int>> integers;
    vector<void*> own;             // where these are, in the order of the plan
    vector<double> inverse;
    vector<vector<Vec3>> forces;
};

static const bool registered = [] {
    for (string name : {"Reference", "CPU"})
        makers()[name] = [=](ContextImpl& c, const vector<int>&) { return new PlainSteps(c, name == "CPU"); };
    return true;
}();

}
